"""What is published: a wheel and a source distribution that build, install and run from the file."""

import os
import site
import subprocess
import sys
import tarfile
import venv
import zipfile
from pathlib import Path

import pytest

import rodjax

ROOT = Path(__file__).parents[1]


@pytest.mark.slow
@pytest.mark.skipif(not (ROOT / "pyproject.toml").exists(), reason="the tests run without the repository")
def test_wheel_and_sdist_build_and_the_wheel_runs(tmp_path):
    """In an environment that has the packages of this one, and rodjax from the wheel alone."""
    folder = tmp_path / "venv"
    venv.create(folder, with_pip=True)
    python = folder / "bin" / "python"
    environment = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "JAX_ENABLE_X64")}

    def run(*command: str | Path) -> str:
        done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=tmp_path, env=environment)
        assert done.returncode == 0, done.stderr
        return done.stdout

    run(python, "-m", "pip", "install", "-q", "hatchling")
    subprocess.run([python, "-m", "hatchling", "build", "-d", tmp_path / "dist"], check=True, cwd=ROOT, env=environment)
    (wheel,), (source,) = ([*(tmp_path / "dist").glob(f"rodjax-*.{kind}")] for kind in ("whl", "tar.gz"))
    assert rodjax.__version__ in wheel.name
    names = zipfile.ZipFile(wheel).namelist()
    assert "rodjax/routing/page.html" in names
    assert not [name for name in names if name.startswith(("tests", "experiments"))]
    with tarfile.open(source) as archive:
        inside = {name.partition("/")[2] for name in archive.getnames()}
    assert {"rodjax/routing/page.html", "tests/test_package.py", "docs/index.md", "CHANGELOG.md", "LICENSE"} <= inside
    run(python, "-m", "pip", "install", "-q", "--no-deps", wheel)
    (own,) = folder.glob("lib/python*/site-packages")
    # A path in a .pth file: the editable rodjax beside these packages is not found by it.
    (own / "others.pth").write_text("\n".join(site.getsitepackages()))
    told = run(
        python, "-c", "import rodjax; print(rodjax.__file__); rodjax.solve(rodjax.problems.hanging_cable(), segments=8)"
    )
    assert Path(told.strip()).is_relative_to(folder)
    assert run(folder / "bin" / "rodjax", "--version").strip() == f"rodjax {rodjax.__version__}"
    assert sys.version_info >= (3, 11)
