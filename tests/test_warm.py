"""`rodjax warm`: compiles what a file will need, or the usual scenes."""

from pathlib import Path

from rodjax import cli, warm

EXPERIMENTS = Path(__file__).parent.parent / "experiments"
SCENE = """
[rod]
length = "1 m"
EI = "0.02 N m^2"
GJ = "0.015 N m^2"
EA = "1e4 N"

[start]
support = "clamp"
position = "[0, 0, 0] m"
tangent = [1, 0, 0]

[end]
support = "free"

[solve]
segments = 4
"""


def test_a_file_is_run_as_its_own_command_does(tmp_path):
    def command(name: str) -> list[str]:
        return warm.command_for(EXPERIMENTS / name, [Path("data.csv")], tmp_path)

    assert command("fits/fit.toml")[0] == "fit"
    assert command("fits/fit.toml")[2] == "data.csv"
    assert command("routes/brake_line.toml")[0] == "route"
    # Data that its command does not take are refused by that.
    assert command("scenes/hanging_cable.toml")[:3:2] == ["solve", "data.csv"]
    report = tmp_path / "report.toml"
    report.write_text('scene = "scene.toml"\n[limits]\nbend_radius = 5\n')
    assert warm.command_for(report, [], tmp_path)[0] == "report"


def test_warm_leaves_nothing_but_programs(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("scene.toml").write_text(SCENE)
    assert cli.main(["warm", "scene.toml"]) == 0
    out, err = capsys.readouterr()
    assert out == "no programs are kept\n"  # tests keep none
    assert not err
    assert [path.name for path in tmp_path.iterdir()] == ["scene.toml"]
    assert cli.main(["warm", "missing.toml"]) == 2
    assert capsys.readouterr().err == "rodjax: missing.toml: cannot be read: No such file or directory\n"


def test_the_usual_scenes_are_done_one_after_another(monkeypatch):
    done = []
    monkeypatch.setattr(warm, "solve", lambda scene, guess=None: done.append(scene))
    monkeypatch.setattr(warm, "describe", lambda result: None)
    monkeypatch.setattr(warm, "solve_path", lambda scenes, **settings: done.extend(scenes))
    warm.warm(warm.usual_jobs())
    assert len(done) == 2 * (2 * 5 + 25)  # as NumPy code and compiled
