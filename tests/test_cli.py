"""The command `rodjax`: its output, its exit codes and its one-line messages."""

import subprocess
import sys
import types
from pathlib import Path

import numpy as np
import pytest

import rodjax
from rodjax.cli import main
from rodjax.io.files import load
from rodjax.io.scene_writing import write_scene

SCENES = Path(__file__).parents[1] / "experiments" / "scenes"
HANGING = str(SCENES / "hanging_cable.toml")


def mistake(capsys: pytest.CaptureFixture[str]) -> str:
    """The one line on stderr."""
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("rodjax: ")
    assert err.count("\n") == 1
    return err


def test_solve_prints_and_writes_the_equilibrium(tmp_path, capsys):
    result, picture = tmp_path / "a.vtkhdf", tmp_path / "a.png"
    assert main(["solve", HANGING, "-o", str(result), "--plot", str(picture)]) == 0
    out, err = capsys.readouterr()
    assert err == ""
    assert "clamp to clamp, 1 m, 50 segments" in out
    assert "converged" in out
    expected = rodjax.solve(rodjax.problems.hanging_cable(), segments=50)
    elastic = float(expected.elastic_energy)
    assert f"{elastic:.6g} J elastic, {float(expected.energy) - elastic:.6g} J of the loads" in out
    assert f"smallest bend radius  {1 / float(np.max(expected.curvature)):.4g} m" in out
    assert f"{float(expected.end_force[2]):.4g}" in out
    np.testing.assert_allclose(load(result).nodes, expected.nodes, atol=1e-9)
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_solve_prints_what_clips_and_obstacles_do(tmp_path, capsys):
    text = (SCENES / "hanging_cable.toml").read_text().replace("segments = 50", "segments = 16")
    text += """
[[clips]]
at = "0.3 m"
position = "[0.25, 0, -0.02] m"
[[obstacles]]
kind = "plane"
point = "[0, 0, -0.12] m"
normal = [0, 0, 1]
"""
    path = tmp_path / "a.toml"
    path.write_text(text)
    assert main(["solve", str(path)]) == 0
    out, err = capsys.readouterr()
    assert err == ""
    floor = next(line for line in out.splitlines() if line.endswith("obstacles[0] (Plane)"))
    clip = next(line for line in out.splitlines() if line.startswith("clip 0"))
    ends = [next(line for line in out.splitlines() if line.startswith(name)) for name in ("s = 0 ", "s = L")]
    (_, _, up), (_, _, held) = (list(map(float, line.split()[k : k + 3])) for line, k in ((floor, 0), (clip, 2)))
    first, last = (float(line.split()[5]) for line in ends)
    # All together the weight, to the four digits that are printed.
    weight = 1200 * np.pi * 0.005**2 * 9.81
    assert up > 0.05 * weight
    assert up + held + last - first == pytest.approx(weight, rel=2e-3)
    assert "clearance to obstacles[0] (Plane)  " in out


def test_solve_prints_one_row_a_scene_of_a_path_and_draws_the_last(tmp_path, capsys):
    picture = tmp_path / "a.png"
    assert main(["solve", str(SCENES / "figure_1.toml"), "--plot", str(picture)]) == 0
    rows = capsys.readouterr().out.splitlines()[2:]
    assert [row.split()[0] for row in rows] == [str(k) for k in range(26)]
    assert all(row.endswith("converged") for row in rows)
    # The end frame has turned by 360 degrees; what the Omega's writhe takes is missing in the twist.
    assert 250 < float(rows[-1].split()[1]) < 300
    assert picture.exists()


def test_a_solve_that_does_not_converge_exits_with_3_and_still_writes(tmp_path, capsys, monkeypatch):
    few = rodjax.NonlinearCG(max_iterations=2)
    solve, solve_path = rodjax.solve, rodjax.solve_path
    monkeypatch.setattr(rodjax, "solve", lambda *args, **options: solve(*args, **options, solver=few))
    monkeypatch.setattr(rodjax, "solve_path", lambda *args, **options: solve_path(*args, **options, solver=few))
    result, picture = tmp_path / "a.vtkhdf", tmp_path / "a.png"
    assert main(["solve", HANGING, "-o", str(result), "--plot", str(picture)]) == 3
    out, err = capsys.readouterr()
    assert "not converged" in out
    assert err.startswith(f"rodjax: {HANGING}: not converged: stopped at the largest number of iterations")
    assert err.count("\n") == 1
    assert not load(result).converged
    assert picture.exists()
    assert main(["solve", str(SCENES / "figure_1.toml")]) == 3
    assert "figure_1.toml: steps 0, 1, 2" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ([], "COMMAND"),
        (["bend"], "'solve', 'view', 'sweep', 'merge', 'fit', 'report', 'route', 'demo', 'warm'"),
        (["solve"], "SCENE.toml"),
        (["solve", HANGING, "--fast"], "--fast"),
        (["solve", "missing.toml"], "missing.toml: cannot be read"),
        (["solve", HANGING, "-o", "a.vtk"], "-o must end in .vtkhdf"),
        (["solve", HANGING, "--plot", "a.jpeg"], "--plot must end in .png"),
        (["solve", HANGING, "-o", "missing/a.vtkhdf"], "folder that exists"),
        (["demo", "--segments", "1"], "--segments: must be a whole number from 2 to 100000"),
        (["demo", "--segments", "many"], "--segments: must be a whole number from 2 to 100000"),
    ],
)
def test_mistakes_exit_with_2_and_one_line(arguments, said, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == 2
    assert said in mistake(capsys)


def test_a_mistake_in_the_scene_names_file_and_key(tmp_path, capsys):
    scene = tmp_path / "scene.toml"
    scene.write_text(Path(HANGING).read_text().replace('"5 mm"', "5"))
    assert main(["solve", str(scene)]) == 2
    assert mistake(capsys).startswith(f"rodjax: {scene}: rod.radius must have a unit")


def test_an_output_that_cannot_be_written_exits_with_2(tmp_path, capsys, monkeypatch):
    def full_disk(equilibrium, path):
        raise OSError(28, "No space left on device", str(path))

    monkeypatch.setattr("rodjax.commands.solve.save", full_disk)
    assert main(["solve", HANGING, "-o", str(tmp_path / "a.vtkhdf")]) == 2
    err = capsys.readouterr().err
    assert err.startswith("rodjax: No space left on device")
    assert err.count("\n") == 1
    (tmp_path / "folder.vtkhdf").mkdir()
    assert main(["solve", HANGING, "-o", str(tmp_path / "folder.vtkhdf")]) == 2
    assert "a file that can be written" in mistake(capsys)


def test_demo_gets_its_folder_and_segments(tmp_path, monkeypatch):
    given = []
    stub = types.ModuleType("rodjax.demo")
    setattr(stub, "run", lambda out, segments: given.append((out, segments)) or 3)  # noqa: B010
    monkeypatch.setitem(sys.modules, "rodjax.demo", stub)
    assert main(["demo", "--out", str(tmp_path), "--segments", "20"]) == 3
    assert given == [(tmp_path, 20)]


def test_works_without_a_cache_folder(tmp_path, monkeypatch):
    blocked = tmp_path / "file"
    blocked.touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(blocked))
    assert main(["solve", HANGING]) == 0


def test_help_and_version_exit_with_0(capsys):
    for arguments in (["--help"], ["solve", "--help"], ["fit", "--help"], ["demo", "--help"], ["--version"]):
        with pytest.raises(SystemExit, match=r"^0$"):
            main(arguments)
    assert rodjax.__version__ in capsys.readouterr().out


def test_python_m_rodjax(tmp_path):
    scene = tmp_path / "cantilever.toml"
    write_scene(rodjax.problems.cantilever(), scene, segments=20)
    command = [sys.executable, "-W", "error", "-m", "rodjax", "solve"]
    solved = subprocess.run([*command, str(scene)], capture_output=True, text=True, check=False)
    assert solved.returncode == 0, solved.stderr
    assert "clamp to free, 1 m, 20 segments" in solved.stdout
    failed = subprocess.run([*command, str(tmp_path)], capture_output=True, text=True, check=False)
    assert failed.returncode == 2
    assert failed.stderr == f"rodjax: {tmp_path}: cannot be read: Is a directory\n"
