"""The README's example prints and writes what the README says; the documentation's: `test_docs.py`."""

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
