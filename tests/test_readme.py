"""The README's examples print and write what the README says."""

import re
from pathlib import Path

import numpy as np
import pytest

README = Path(__file__).parents[1] / "README.md"


@pytest.mark.skipif(not README.exists(), reason="the tests run without the repository")
def test_the_example_prints_its_numbers(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    code, printed = re.search(r"```python\n(.*?)```\n\n```text\n(.*?)```", README.read_text(), re.S).groups()
    exec(compile(code, str(README), "exec"), {})
    ours = capsys.readouterr().out
    number = re.compile(r"-?\d+\.\d+(?:e[-+]\d+)?")
    # All but the residual on the first line, which is rounding.
    shown, found = ([float(x) for x in number.findall(text.split("\n", 1)[1])] for text in (printed, ours))
    np.testing.assert_allclose(found, shown, rtol=1e-3)
    assert len(shown) == 8
    assert (tmp_path / "cable.vtkhdf").stat().st_size > 10_000


@pytest.mark.slow
@pytest.mark.skipif(not README.exists(), reason="the tests run without the repository")
def test_the_example_of_a_route_finds_one(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    blocks = re.findall(r"```python\n(.*?)```", README.read_text(), re.S)
    (parts,) = (block.split("first =")[0] for block in blocks if "first =" in block)
    (route,) = (block for block in blocks if "rj.route(" in block)
    variables: dict = {}
    exec(compile(parts + route, str(README), "exec"), variables)
    assert variables["route"].feasible
    assert "16 of 16 starts" in capsys.readouterr().out
    files = {f"report{suffix}" for suffix in (".txt", ".csv", ".json", ".png", ".html")}
    assert {path.name for path in (tmp_path / "route").iterdir()} == files
