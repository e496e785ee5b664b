"""The documentation: its blocks of code run, its links lead somewhere, its files are those that it shows."""

import re
import runpy
import shlex
import tomllib
from pathlib import Path

import matplotlib.image
import pytest

import rodjax as rj
from rodjax.cli import _parser, main

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
pytestmark = pytest.mark.skipif(not DOCS.exists(), reason="the tests run without the repository")
PAGES = [
    "index.md",
    pytest.param("how-to/index.md", marks=pytest.mark.slow),
    pytest.param("tutorials/stiffness.md", marks=pytest.mark.slow),
    pytest.param("tutorials/design.md", marks=pytest.mark.slow),
    pytest.param("tutorials/route.md", marks=pytest.mark.slow),
]


# A search from one start here.
FEWER = {"tutorials/route.md": ("starts=16", "starts=1")}


@pytest.mark.parametrize("page", PAGES)
def test_blocks_of_code_run(page, tmp_path, monkeypatch, capsys):
    """One after another in one namespace; what they assert holds."""
    monkeypatch.chdir(tmp_path)
    text = (DOCS / page).read_text()
    many, few = FEWER.get(page, ("", ""))
    assert many in text
    blocks = re.findall(r"```python\n(.*?)```", text.replace(many, few) if many else text, re.S)
    variables: dict = {}
    for block in blocks:
        exec(compile(block, str(DOCS / page), "exec"), variables)
    assert blocks
    assert capsys.readouterr().out


def test_every_page_with_code_is_run():
    """The blocks of cluster.md run in `test_cluster.py`, but for that which needs SLURM."""
    with_code = {str(path.relative_to(DOCS)) for path in DOCS.rglob("*.md") if "```python" in path.read_text()}
    run = {page if isinstance(page, str) else page.values[0] for page in PAGES}
    assert with_code - run == {"cluster.md"}


def commands() -> list[str]:
    """Lines of the pages that call rodjax, those that go on in a next line as one."""
    texts = [path.read_text().replace("\\\n", " ") for path in [*DOCS.rglob("*.md"), ROOT / "README.md"]]
    lines = [line for text in texts for line in re.findall(r"^    (?:\S*/)?(rodjax \S.*)$", text, re.M)]
    return lines + [line for text in texts for line in re.findall(r"`(rodjax \w+ [^`]*)`", text)]


def test_commands_are_those_of_the_command_line(monkeypatch):
    """They parse, and the files of the repository that they name are there."""
    monkeypatch.setenv("SLURM_ARRAY_TASK_ID", "3")
    found = commands()
    assert len(found) > 15
    for line in found:
        words = shlex.split(line.replace("$SLURM_ARRAY_TASK_ID", "3"), comments=True)[1:]
        if not any(word.isupper() or word == "--help" for word in words):  # a description of one
            _parser().parse_args(words)
        for word in words:
            assert not word.startswith("experiments/") or (ROOT / word).exists(), line


SCRIPTS = {
    "over_a_pipe": "",
    "harness": "",
    "measured": "",
    "fold": "",
    "bend_radius_map": "COUNT = 20",
}


@pytest.mark.slow
@pytest.mark.parametrize("name", SCRIPTS)
def test_scripts_of_the_gallery_make_their_pictures(name, tmp_path, monkeypatch, capsys):
    """What they assert holds; the one that takes a minute has fewer cases here, and so another picture."""
    monkeypatch.chdir(tmp_path)
    text, script = (DOCS / "gallery" / f"{name}.py").read_text(), tmp_path / f"{name}.py"
    assert SCRIPTS[name] in text
    script.write_text(text.replace("COUNT = 20", "COUNT = 3"))
    runpy.run_path(str(script), run_name="__main__")
    assert capsys.readouterr().out
    made, kept = (matplotlib.image.imread(folder / f"{name}.png") for folder in (tmp_path, DOCS / "gallery"))
    # Fonts differ from machine to machine.
    assert abs(made.shape[0] - kept.shape[0]) < 40
    assert SCRIPTS[name] or abs(made.mean() - kept.mean()) < 0.02


def test_the_gallery_shows_each_of_its_scripts():
    text = (DOCS / "gallery" / "index.md").read_text()
    assert {path.stem for path in (DOCS / "gallery").glob("*.py")} == {*SCRIPTS}
    for name in SCRIPTS:
        assert f"]({name}.png)" in text
        assert f"]({name}.py)" in text
        assert (DOCS / "gallery" / f"{name}.png").exists()


def test_every_picture_has_a_script():
    scripts = [*(ROOT / "experiments").glob("*.py"), *(DOCS / "gallery").glob("*.py"), *(ROOT / "rodjax").glob("*.py")]
    texts = "".join(path.read_text() for path in scripts)
    for picture in DOCS.rglob("*.png"):
        named = picture.name in texts or f'"{picture.stem}{{suffix}}"' in texts
        assert named or re.search(rf"{picture.stem}\{{suffix\}}", texts), picture


@pytest.mark.slow
def test_the_first_tutorial_is_the_file_that_it_copies(tmp_path, monkeypatch, capsys):
    text = (DOCS / "tutorials" / "hose.md").read_text()
    shown = tomllib.loads("".join(re.findall(r"```toml\n(.*?)```", text, re.S)))
    hose = ROOT / "experiments" / "routes" / "hose.toml"
    assert shown | {"title": "Coolant hose"} == tomllib.loads(hose.read_text())
    commands = re.findall(r"^    (\S.*)$", text.split("## The file")[0], re.M)
    assert len(commands) == 4
    # The last two of the four; the README's test installs.
    monkeypatch.chdir(tmp_path)
    assert commands[2] == "cp experiments/routes/hose.toml my_hose.toml"
    Path("my_hose.toml").write_text(hose.read_text())
    assert main(commands[3].split()[1:]) == 0
    verdict = re.search(r"```text\n(.*?)\n```", text)[1]  # pyright: ignore[reportOptionalSubscript]
    assert verdict == capsys.readouterr().out.splitlines()[1]
    assert (tmp_path / "my_hose" / "report.html").stat().st_size > 50_000


def headings(page: Path) -> set[str]:
    """What links can point to: headings as GitHub and MkDocs name them, and on the site what `:::` documents."""
    text = re.sub(r"```.*?```", "", page.read_text(), flags=re.S)
    titles = [title.lower() for title in re.findall(r"^#+ (.*)$", text, re.M)]
    slugs = {re.sub(r"[\s]+", "-", re.sub(r"[^\w\s-]", "", title).strip()) for title in titles}
    return slugs | set(re.findall(r"^::: (\S+)$", text, re.M))


def test_links_lead_to_files():
    """And to headings of them."""
    dead = []
    for page in [*DOCS.rglob("*.md"), ROOT / "README.md", ROOT / "CHANGELOG.md"]:
        for link in re.findall(r"\]\(([^)\s]+)\)", page.read_text()):
            if re.match(r"https?:|mailto:", link):
                continue
            path, _, heading = link.partition("#")
            target = page.parent / path if path else page
            is_there = target.exists()
            if is_there and heading:
                named = headings(target)
                is_there = heading in named or any(heading.startswith(f"{name}.") for name in named)
            if not is_there:
                dead.append(f"{page.name}: {link}")
    assert not dead


def test_functions_of_the_theory_are_there():
    import importlib

    names = re.findall(r"`(rodjax(?:\.\w+)+)`", (DOCS / "theory.md").read_text())
    assert len(names) >= 15
    for name in names:
        module, _, attribute = name.rpartition(".")
        if module.rpartition(".")[2][0].isupper():  # a method
            module, _, owner = module.rpartition(".")
            attribute = f"{owner}.{attribute}"
        found = importlib.import_module(module)
        for part in attribute.split("."):
            found = getattr(found, part)


def test_the_changes_and_the_citation_are_of_this_version():
    assert f"## {rj.__version__}\n" in (ROOT / "CHANGELOG.md").read_text()
    assert f"\nversion: {rj.__version__}\n" in (ROOT / "CITATION.cff").read_text()


@pytest.mark.slow
def test_the_pictures_are_made_by_their_script(tmp_path):
    from test_experiments import script

    for path in script("site_pictures").main(["--out", str(tmp_path)]):
        made, kept = (matplotlib.image.imread(folder / path.name) for folder in (tmp_path, DOCS))
        # Fonts differ from machine to machine.
        assert abs(made.shape[0] - kept.shape[0]) < 40
        assert abs(made.mean() - kept.mean()) < 0.02
