"""The order of the folders: modules import from those before them only, and in no circle."""

import ast
import graphlib
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1] / "rodjax"
# Folders, and modules beside them, each of which may import from those in the lines above it.
ORDER = (
    ("atomic_write", "checks", "file_lock", "units", "version", "warn"),
    ("notes",),
    ("programs",),
    ("linalg",),
    ("geometry",),
    ("model",),
    ("mechanics",),
    ("discretization",),
    ("solving",),
    ("paths",),
    ("analysis",),
    ("io",),
    ("drawing", "problems"),
    ("plot",),
    ("filming",),
    ("identification",),
    ("routing",),
    ("sweeps",),
    ("window",),
    ("cluster", "demo", "warm"),
    ("rodjax",),
    ("commands",),
    ("cli", "cosseratbench"),
    ("__main__",),
)
PLACE = {name: number for number, names in enumerate(ORDER) for name in names}


def test_imports_point_to_earlier_folders():
    wrong = [
        f"{module} imports {other}"
        for module, others in imports(for_types=True).items()
        for other in others
        if PLACE[folder(other)] >= PLACE[folder(module)] and folder(other) != folder(module)
    ]
    assert not wrong


def test_imports_make_no_circle():
    """Imports for type checking alone aside."""
    assert list(graphlib.TopologicalSorter(imports(for_types=False)).static_order())


def test_packages_import_nothing():
    """So that a module of a folder can be imported without the others."""
    assert not {name: found for name, found in imports(for_types=True).items() if is_folder(name) and found}


def imports(for_types: bool) -> dict[str, set[str]]:
    """By module, such as `model.rod` (`rodjax` is the package), the modules that it imports, at its top or later."""
    paths = {name_of(path): path for path in ROOT.rglob("*.py")}
    return {name: set(imported(path, set(paths), for_types)) - {name} for name, path in paths.items()}


def imported(path: Path, modules: set[str], for_types: bool) -> Iterator[str]:
    for node in nodes(ast.parse(path.read_text(encoding="utf-8")), for_types):
        names = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path} has a relative import"
            submodules = [f"{node.module}.{alias.name}" for alias in node.names]
            names = [name if name.removeprefix("rodjax.") in modules else str(node.module) for name in submodules]
        yield from (name.removeprefix("rodjax.") for name in names if name.split(".")[0] == "rodjax")


def nodes(tree: ast.AST, for_types: bool) -> Iterator[ast.AST]:
    for node in ast.iter_child_nodes(tree):
        if for_types or not (isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"):
            yield node
            yield from nodes(node, for_types)


def name_of(path: Path) -> str:
    parts = path.relative_to(ROOT.parent).with_suffix("").parts
    return ".".join(part for part in parts[1:] if part != "__init__") or "rodjax"


def folder(module: str) -> str:
    return module.split(".")[0]


def is_folder(module: str) -> bool:
    return (ROOT / module).is_dir()
