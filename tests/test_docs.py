"""The documentation: its blocks of code run, its links lead somewhere, its files are those that it shows."""

import re
import tomllib
from pathlib import Path

import matplotlib.image
import pytest

import rodjax as rj
from rodjax.cli import main

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
pytestmark = pytest.mark.skipif(not DOCS.exists(), reason="the tests run without the repository")
PAGES = [
    "index.md",
    "how-to/index.md",
    pytest.param("tutorials/stiffness.md", marks=pytest.mark.slow),
    pytest.param("tutorials/design.md", marks=pytest.mark.slow),
    pytest.param("tutorials/route.md", marks=pytest.mark.slow),
]


@pytest.mark.parametrize("page", PAGES)
def test_blocks_of_code_run(page, tmp_path, monkeypatch, capsys):
    """One after another in one namespace; what they assert holds."""
    monkeypatch.chdir(tmp_path)
    blocks = re.findall(r"```python\n(.*?)```", (DOCS / page).read_text(), re.S)
    variables: dict = {}
    for block in blocks:
        exec(compile(block, str(DOCS / page), "exec"), variables)
    assert blocks
    assert capsys.readouterr().out


def test_every_page_with_code_is_run():
    """Those that list nothing but files and commands aside, and those that record what was measured."""
    with_code = {str(path.relative_to(DOCS)) for path in DOCS.rglob("*.md") if "```python" in path.read_text()}
    run = {page if isinstance(page, str) else page.values[0] for page in PAGES}
    assert with_code - run <= {"cluster.md", "derivatives.md", "design.md"}


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


def test_links_lead_to_files():
    """And to headings of them."""
    dead = []
    for page in [*DOCS.rglob("*.md"), ROOT / "README.md", ROOT / "CHANGELOG.md"]:
        for link in re.findall(r"\]\(([^)\s]+)\)", page.read_text()):
            if not re.match(r"https?:|mailto:|#", link) and not (page.parent / link.split("#")[0]).exists():
                dead.append(f"{page.name}: {link}")
    assert not dead


def test_functions_of_the_theory_are_there():
    import importlib

    names = re.findall(r"`(rodjax(?:\.\w+)+)`", (DOCS / "theory.md").read_text())
    assert len(names) >= 8
    for name in names:
        module, _, attribute = name.rpartition(".")
        assert hasattr(importlib.import_module(module), attribute), name


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
