"""What is published: a wheel and a source distribution that build, install and run from the file; licences."""

import importlib.metadata
import os
import re
import site
import subprocess
import sys
import tarfile
import venv
import zipfile
from pathlib import Path

import pytest
from packaging.requirements import Requirement

import rodjax

ROOT = Path(__file__).parents[1]

# Licences that allow what Apache-2.0 allows; MPL-2.0 binds changes to files of its own alone (tqdm, certifi).
PERMISSIVE = r"Apache|MIT|BSD|ISC|Python Software Foundation|PSF|MPL|Mozilla|HPND|Zlib|CC0|Unlicense"
# What this environment need not have of the extras: `peers` are programs that experiments compare with.
EXTRAS = ("view", "cad", "meshes", "parquet", "cluster", "docs")


def dependencies(name: str, extras: tuple[str, ...] = ()) -> set[str]:
    """All packages that one needs here, those of its dependencies too, without those that are not installed."""
    found, waiting = set(), [(name, extras)]
    while waiting:
        package, wanted = waiting.pop()
        for line in importlib.metadata.requires(package) or []:
            needed = Requirement(line)
            is_needed = needed.marker is None or any(needed.marker.evaluate({"extra": e}) for e in ("", *wanted))
            if is_needed and needed.name not in found:
                try:
                    importlib.metadata.distribution(needed.name)
                except importlib.metadata.PackageNotFoundError:
                    continue
                found.add(needed.name)
                waiting.append((needed.name, tuple(needed.extras)))
    return found


def licence(package: str) -> str:
    """What a package says of its licence, or the first lines of the file that is it."""
    about = importlib.metadata.metadata(package)
    classifiers = [line for line in about.get_all("Classifier") or [] if line.startswith("License")]
    told = " ".join([about.get("License-Expression") or "", (about.get("License") or "")[:400], *classifiers]).strip()
    if told:
        return told
    files = importlib.metadata.files(package) or []
    texts = [file.read_text()[:400] for file in files if re.search(r"licen[cs]e|copying", file.name, re.I)]
    return " ".join(texts)


def test_licences_of_dependencies_are_permissive():
    packages = dependencies("rodjax", EXTRAS)
    assert {"jax", "numpy", "tqdm"} < packages
    for package in sorted(packages):
        told = licence(package)
        assert re.search(PERMISSIVE, told), f"{package}: {told!r}"
        assert not re.search(r"(?<!L)GPL|GNU General", told), f"{package}: {told!r}"


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
