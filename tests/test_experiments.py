"""A small setting of each experiment, and its numbers."""

import csv
import importlib.util
from pathlib import Path

import pytest

EXPERIMENTS = Path(__file__).parents[1] / "experiments"


def script(name: str):
    spec = importlib.util.spec_from_file_location(name, EXPERIMENTS / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_mass_spring(tmp_path, capsys):
    rows = script("mass_spring").main(["--segments", "10", "--out", str(tmp_path)])
    before, bent, *_, turned = rows
    # Bending comes out alike, to the error of 10 segments.
    assert before["chain_lowest"] == pytest.approx(before["rod_lowest"], rel=0.02)
    assert bent["chain_lowest"] == pytest.approx(bent["rod_lowest"], rel=0.02)
    # A turn of the end frame moves the rod by 8 % of its length and the chain not at all.
    assert turned["chain_from_b"] < 1e-9
    assert turned["chain_out_of_plane"] < 1e-9
    assert turned["rod_from_b"] == pytest.approx(0.0765, abs=0.005)
    assert turned["rod_out_of_plane"] == pytest.approx(0.07, abs=0.005)
    assert capsys.readouterr().out.count("\n") == 8
    with open(tmp_path / "mass_spring.csv", newline="") as file:
        assert [row["stage"] for row in csv.DictReader(file)] == list("abcdef")
    assert (tmp_path / "mass_spring.png").stat().st_size > 10_000


def test_kernels(tmp_path):
    rows = script("kernels").main(["--segments", "4", "--repeats", "1", "--out", str(tmp_path)])
    assert len(rows) == 6 + 7
    assert all(row["us"] > 0 for row in rows)
    assert (tmp_path / "kernels.csv").read_text().count("\n") == len(rows) + 1


def test_rounding_floor():
    ratios = script("rounding_floor").main(["--segments", "10", "100", "--slenderness", "200"])
    # The estimate the solver uses allows 4.
    assert max(ratios.values()) < 4


@pytest.mark.slow
def test_nonlinear_cg(tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("XLA_FLAGS", "")  # the script would set it for all that comes after
    options = ["--segments", "4", "6", "--repeats", "1", "--out", str(tmp_path)]
    rows = script("nonlinear_cg").main(options)
    assert all(row.converged for row in rows)
    for segments, energy in ((4, 20.584261), (6, 20.568931)):
        loose, tight, preconditioned = (row for row in rows if row.segments == segments)
        assert preconditioned.iterations_max <= 40
        assert preconditioned.iterations_mean < 25
        assert tight.iterations_mean > 4 * preconditioned.iterations_mean
        for row in (loose, tight, preconditioned):
            assert row.energy == pytest.approx(energy, rel=1e-6)
    assert "N = 6: the preconditioner takes" in capsys.readouterr().out
    with open(tmp_path / "nonlinear_cg.csv", newline="") as file:
        assert len(list(csv.DictReader(file))) == 6
    assert (tmp_path / "nonlinear_cg.png").stat().st_size > 10_000


def test_cold_start():
    shares = script("cold_start").main(["--count", "5", "--moments", "1", "--segments", "10"])
    assert len(shares) == 3 + 2 * 4
    assert all(share == 1.0 for name, share in shares.items() if name.startswith("clamps"))
