"""What an engineer wants to know of routes of cables, as text, tables and pictures."""

import dataclasses
import datetime
import io
import json
import os
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import equinox as eqx
import numpy as np

from rodjax.atomic_write import replace_file
from rodjax.checks import file_path, instance, is_known, sequence, shown
from rodjax.model.harness import Harness
from rodjax.model.obstacles import Obstacle, checked_obstacles
from rodjax.model.summaries import obstacle_name
from rodjax.notes import note
from rodjax.programs.answers import one_answer
from rodjax.routing import records, report_text
from rodjax.routing.cable_report import Cable, Gradients, cable
from rodjax.routing.limits import Limits
from rodjax.routing.route import Route
from rodjax.solving.harness_result import HarnessEquilibrium
from rodjax.solving.result import Equilibrium
from rodjax.solving.status import Status

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# What a report writes.
FILES = ("report.txt", "report.csv", "report.json", "report.png", "report-along.png", "report.html")
DPI = 130


@dataclasses.dataclass(frozen=True)
class Report:
    """A report of one cable, or of several in one scene; `str` of it is its text.

    - `title`, and `verdict`: a sentence
    - `kept`: whether all of them are equilibria that keep to all limits; `None` where there are no limits
    - `cables`: for each its name, equilibrium, margins, facts, what supports and obstacles apply to it, and gradients
    - `obstacles`, and their `names`
    - `source`: what it was made of, such as the name of a file; `date`: the day on which it was made
    - `design`: what the route of a harness found; that of one cable is told with its gradients
    """

    title: str
    cables: tuple[Cable, ...]
    obstacles: tuple[Obstacle, ...]
    names: tuple[str, ...]
    source: str | None = None
    date: str = dataclasses.field(default_factory=lambda: datetime.date.today().isoformat())
    design: Gradients | None = None

    @cached_property
    def verdict(self) -> str:
        return report_text.verdict(self)

    @property
    def kept(self) -> bool | None:
        each = [cable.kept for cable in self.cables]
        return False if False in each else (True if True in each else None)

    @cached_property
    def drawn(self) -> dict[str, Obstacle]:
        """What pictures show, by name: the obstacles, and those that push the cables."""
        found = dict(zip(self.names, self.obstacles, strict=True))
        for one in self.cables:
            for k, obstacle in enumerate(one.equilibrium.scene.obstacles):
                if not any(eqx.tree_equal(obstacle, other) for other in found.values()):
                    name = obstacle_name(obstacle, k)
                    found[f"{one.name}: {name}" if name in found else name] = obstacle
        return found

    @property
    def margins(self) -> dict[str, float]:
        """The relative margin of each limit by its name; of several cables "cable: name"."""
        return {
            f"{cable.name}: {name}" if len(self.cables) > 1 else name: float(margin)
            for cable in self.cables
            if cable.margins is not None
            for name, margin in zip(cable.margins.names, cable.margins.margin, strict=True)
        }

    def __str__(self) -> str:
        return report_text.text(self)

    def as_dict(self) -> dict[str, Any]:
        """All numbers in SI units, as JSON knows them: `None` for what is infinite or not a number."""
        return records.as_dict(self)

    def figure(self) -> "Figure":
        """The cables, colored by the margin of their bend radius, between the obstacles."""
        from rodjax.routing.pictures import plot_route

        return plot_route(self._sights, self.drawn, self._heading)

    def along(self) -> "Figure":
        """Curvature and bend radius, twist, tension, moment and clearances over the arclength, with their limits."""
        from rodjax.routing.diagrams import plot_along

        return plot_along(self.cables, self.obstacles, self.names)

    def html(self) -> str:
        """The same as a page that turns with the mouse and needs nothing but a browser."""
        from rodjax.routing.web_page import web_page

        return web_page(self, self._sights)

    def save(self, folder: str | os.PathLike[str]) -> list[Path]:
        """Writes report.txt, report.csv, report.json, report.png, report-along.png and report.html; returns their
        names.

        The folder is made where it is not there. Raises `OSError` where they cannot be written.
        """
        folder = file_path(folder, "folder")
        note("drawing")
        image, diagrams = io.BytesIO(), io.BytesIO()
        self.figure().savefig(image, format="png", dpi=DPI)
        self.along().savefig(diagrams, format="png", dpi=DPI)
        contents = (
            f"{self}\n".encode(),
            records.csv_text(self).encode(),
            f"{json.dumps(self.as_dict(), indent=1, allow_nan=False)}\n".encode(),
            image.getvalue(),
            diagrams.getvalue(),
            self.html().encode(),
        )
        folder.mkdir(parents=True, exist_ok=True)
        for name, content in zip(FILES, contents, strict=True):
            replace_file(folder / name, content)
        return [folder / name for name in FILES]

    @property
    def _heading(self) -> str:
        return f"{self.title}: {self.verdict}"

    @cached_property
    def _sights(self) -> list[Any]:
        from rodjax.routing.view_data import cable_view, extent

        size = extent([cable.equilibrium for cable in self.cables])
        return [cable_view(cable.name, cable.equilibrium, cable.limits, size) for cable in self.cables]


@one_answer
def report(
    equilibrium: Any,
    *,
    limits: Any = None,
    obstacles: Any = (),
    names: Any = None,
    gradients: Any = None,
    title: str | None = None,
    source: str | None = None,
    progress: bool | None = None,
) -> Report:
    """A report of one cable in equilibrium, or of several in one scene.

    **Arguments:**

    - `equilibrium`: one `Equilibrium`, a list of them, or a dictionary of them by the names of the cables; or that of a
      harness, whose rods are the cables: whether they are stable is told of the whole; or a `Route`, whose limits,
      obstacles, their names and gradients are taken where none are given, and the bounds of its variables.
    - `limits`: `Limits` of all cables, those of clips of the cables that have any; or a list of `Limits` or `None`, one
        for each cable; `None`: none.
    - `obstacles`: a list of `Obstacle`, which push nothing; without a limit of clearance they are drawn, and the
        nearest is told. Those of the scenes are drawn too, and what they apply to the cables is told.
    - `names`: of the obstacles; `None`: "obstacle 0" and so on.
    - `gradients`: of the margins by design variables: a `Route` or `Gradients`, or a list, one for each cable.
    - `title`: `None`: "Route".
    - `source`: what the cables were read from, told beside the date and the version.
    - `progress`: whether a call that takes longer than 2 s says on stderr what it does; `None`: in a terminal or
        notebook.

    Raises `ValueError` or `TypeError` for other arguments, for a stack of equilibria or one without a finite shape, and
    as `rodjax.margins` does.
    """
    if isinstance(equilibrium, Route):
        route = equilibrium
        equilibrium, gradients = route.verified, route if gradients is None else gradients
        limits = route.limits if limits is None else limits
        if isinstance(obstacles, tuple) and not obstacles:
            obstacles, names = route.obstacles, route.obstacle_names if names is None else names
    cables = _cables(equilibrium)
    each_limits = _each(limits, "limits", (Limits,), len(cables))
    if isinstance(limits, Limits) and any(one.scene.clips for one in cables.values()):
        each_limits = [limits if one.scene.clips else limits.without_clips() for one in cables.values()]
    each_gradients = _each(gradients, "gradients", (Gradients, Route), len(cables))
    obstacles = sequence(obstacles, "obstacles", "Obstacle")
    if obstacles:
        obstacles = checked_obstacles(obstacles)
    names = [f"obstacle {k}" for k in range(len(obstacles))] if names is None else names
    names = sequence(names, "names", "names of obstacles")
    if len(names) != len(obstacles) or not all(isinstance(name, str) for name in names) or len({*names}) < len(names):
        raise ValueError(
            f"names must be {len(obstacles)} different ones, one for each obstacle, got {shown(list(names))}"
        )
    for name, text in (("title", title), ("source", source)):
        if text is not None:
            instance(text, name, str)
    note("checking limits, supports and stability")

    design = None
    if isinstance(gradients, Route) and isinstance(gradients.scene, Harness):
        design = Gradients.of(gradients)

    def of_cable(name: str, one: Gradients | Route | None) -> Gradients | None:
        if not isinstance(one, Route):
            return one
        of_one = Gradients.of(one, name if isinstance(one.scene, Harness) else None)
        return of_one if design is None else of_one._replace(remark="", ranges=None)

    found = tuple(
        cable(name, one, limit, obstacles, names, of_cable(name, gradient))
        for (name, one), limit, gradient in zip(cables.items(), each_limits, each_gradients, strict=True)
    )
    return Report("Route" if title is None else title, found, obstacles, names, source, design=design)


def _cables(equilibrium: Any) -> dict[str, Equilibrium]:
    if isinstance(equilibrium, HarnessEquilibrium):
        equilibrium = dict(equilibrium.items())
    elif isinstance(equilibrium, Equilibrium):
        equilibrium = {"cable": equilibrium}
    elif not isinstance(equilibrium, Mapping):
        given = sequence(equilibrium, "equilibrium", "Equilibrium")
        equilibrium = {f"cable {k}": one for k, one in enumerate(given)}
    if not equilibrium:
        raise ValueError("equilibrium must be at least one Equilibrium, got none")
    for name, one in equilibrium.items():
        instance(name, "the name of a cable", str)
        instance(one, f"equilibrium[{name!r}]" if len(equilibrium) > 1 else "equilibrium", Equilibrium)
        if not is_known(one):
            raise ValueError(
                "equilibrium must hold numbers, got a traced one: call report outside jax.jit, vmap and grad"
            )
        if one.s.ndim != 1:
            raise ValueError(
                f"equilibrium must be single ones, got a stack of shape {one.s.shape[:-1]}; "
                "jax.tree.map(lambda leaf: leaf[-1], path) takes the last one"
            )
        if not all(bool(np.all(np.isfinite(x))) for x in (one.nodes, one.curvature, one.tension)):
            raise ValueError(f"equilibrium must have a finite shape: {Status(int(one.status)).message}")
    return dict(equilibrium)


def _each(value: Any, name: str, kinds: tuple[type, ...], count: int) -> tuple[Any, ...]:
    """One for each cable."""
    # A tuple of numbers may be a kind itself.
    if value is None or isinstance(value, kinds):
        return (value,) * count
    each = sequence(value, name, " or ".join(kind.__name__ for kind in kinds))
    if len(each) != count:
        raise ValueError(f"{name} must be one for all cables, or one for each of {count}, got {len(each)}")
    for k, one in enumerate(each):
        if one is not None:
            instance(one, f"{name}[{k}]", kinds)
    return each
