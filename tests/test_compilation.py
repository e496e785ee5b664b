"""The persistent compilation cache."""

import subprocess
import sys


def test_the_cache_is_filled(tmp_path):
    code = (
        "import sys, rodjax as rj; print(rj.enable_compilation_cache(sys.argv[1]));"
        "rj.solve(rj.problems.cantilever(0.1), segments=4)"
    )
    folder = tmp_path / "new" / "folder"
    run = subprocess.run([sys.executable, "-c", code, str(folder)], capture_output=True, text=True, check=True)
    assert run.stdout.strip() == str(folder)
    assert any(folder.iterdir())
