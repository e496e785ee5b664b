"""What there is to say of one cable of a route, in numbers."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from rodjax.analysis.curvature import curvature_along, most_curved
from rodjax.analysis.pushes import Push, pushes
from rodjax.analysis.reactions import Reaction, reactions
from rodjax.model.along import Along
from rodjax.model.obstacles import Obstacle
from rodjax.model.scene import has_potential
from rodjax.paths.modes import lowest_mode
from rodjax.routing.limits import Limits
from rodjax.routing.margins import Margins, margins
from rodjax.routing.route import Route
from rodjax.solving.description import describe
from rodjax.solving.result import Equilibrium
from rodjax.solving.result_errors import estimated_errors

# Limits that are put where none are asked for, so that what they limit is measured too.
WITHOUT = {"bend_radius": 1.0, "clearance": 0.0, "twist": 1.0, "strain": 1.0}
CLEARANCE = "smallest clearance"
# Part of the radius by which a cable that lies on an obstacle may be within it, between its nodes.
WITHIN = 0.01
# Radians by which a rod turns along its whole length, at most, where it is straight but for rounding.
STRAIGHT = 1e-8
# Of which limit a margin is, by how its name begins.
BEGINNINGS = {"bend radius": "bend_radius", "clearance to ": "clearance", "twist": "twist", "strain": "strain"}


class Gradients(NamedTuple):
    """Derivatives of margins by design variables.

    - `variables`: names, `units`: of their values (v,)
    - `margins`: names, as of `rodjax.Margins`
    - `derivatives` (m, v): of each relative margin by each variable, by its unit
    - `remark`: told beside them; of a route whether it is an optimum, and what holds it
    - `ranges` (v, 2): between which a route sought the values, and `active`: at which end of it each is held, or ""
    """

    variables: tuple[str, ...]
    units: tuple[str, ...]
    values: Float[np.ndarray, "v"]
    margins: tuple[str, ...]
    derivatives: Float[np.ndarray, "m v"]
    remark: str = ""
    ranges: Float[np.ndarray, "v 2"] | None = None
    active: tuple[str, ...] = ()

    @staticmethod
    def of(route: Route, cable: str | None = None) -> "Gradients":
        """Those of the best route that was found; of a harness those of a cable, by its name."""
        prefix = "" if cable is None else f"{cable}: "
        names = [name for name in route.gradients if name != "objective" and name.startswith(prefix)]
        margins = tuple(name.removeprefix(prefix) for name in names)
        rows = [np.asarray(route.gradients[name]) for name in names]
        derivatives = np.reshape(rows, (len(rows), len(route.names)))
        ranges = np.stack([np.asarray(route.lower), np.asarray(route.upper)], axis=-1)
        ends = [
            [end for end in ("lower", "upper") if f"{name} at its {end} bound" in route.multipliers]
            for name in route.names
        ]
        return Gradients(
            route.names,
            route.units,
            np.asarray(route.numbers),
            margins,
            derivatives,
            route.optimality,
            ranges,
            tuple(" and ".join(end) for end in ends),
        )


class Fact(NamedTuple):
    """A number of a cable in SI units, `None` where there is none; `s` [m]: where that is, `note`: what is special."""

    name: str
    value: float | None
    unit: str
    s: float | None = None
    note: str = ""


class Cable(NamedTuple):
    """One cable of a report: what it keeps to, what was found of it, and what supports and obstacles apply to it."""

    name: str
    equilibrium: Equilibrium
    limits: Limits | None
    margins: Margins | None
    facts: list[Fact]
    reactions: list[Reaction]
    pushes: list[Push]
    gradients: Gradients | None
    outcome: str

    @property
    def converged(self) -> bool:
        return bool(self.equilibrium.converged)

    @property
    def within(self) -> float:
        """How deep it lies within an obstacle of which no clearance is asked [m]; 0 of what lies on one."""
        if self.limits is not None and self.limits.clearance is not None:
            return 0.0
        radius = self.equilibrium.scene.rod.radius
        depth = max((-(fact.value or 0.0) for fact in self.facts if fact.name == CLEARANCE), default=0.0)
        thickest = np.max(np.asarray(radius.samples if isinstance(radius, Along) else radius)) if depth > 0 else 0.0
        return depth if depth > WITHIN * thickest else 0.0

    @property
    def kept(self) -> bool | None:
        """Whether it is an equilibrium that keeps to all limits; `None` where there are no limits."""
        if not self.converged:
            return False
        return None if self.margins is None else bool(np.all(np.asarray(self.margins.margin) >= 0))


def cable(
    name: str,
    equilibrium: Equilibrium,
    limits: Limits | None,
    obstacles: tuple[Obstacle, ...],
    names: Sequence[str],
    gradients: Gradients | None,
) -> Cable:
    """All there is to say of one equilibrium. Raises as `rodjax.margins` does."""
    everything = _filled(limits, equilibrium, obstacles)
    has_clearance = everything.clearance is not None
    found = margins(equilibrium, everything, obstacles if has_clearance else (), names if has_clearance else None)
    found = jax.tree.map(np.asarray, found)
    multiple = 1.0 if everything.bend_radius is None else float(everything.bend_radius)
    return Cable(
        name,
        equilibrium,
        limits,
        None if limits is None else _asked(found, limits),
        _facts(equilibrium, found, multiple),
        reactions(equilibrium),
        pushes(equilibrium),
        gradients,
        describe(equilibrium),
    )


def _filled(limits: Limits | None, equilibrium: Equilibrium, obstacles: Sequence[Obstacle]) -> Limits:
    given = {} if limits is None else {name: getattr(limits, name) for name in limits.__dataclass_fields__}
    without = dict(WITHOUT)
    has_radius = equilibrium.scene.rod.radius is not None
    if not has_radius:
        del without["bend_radius"]
    if not (has_radius and obstacles):
        del without["clearance"]
    return Limits(**(without | {name: value for name, value in given.items() if value is not None}))


def _limit_of(name: str) -> str | None:
    return next((limit for begin, limit in BEGINNINGS.items() if name.startswith(begin)), None)


def _asked(found: Margins, limits: Limits) -> Margins:
    """Those of limits that were given."""
    limit_of = [_limit_of(name) for name in found.names]
    kept = [k for k, limit in enumerate(limit_of) if limit is None or getattr(limits, limit) is not None]
    chosen: dict[str, Any] = {
        name: tuple(getattr(found, name)[k] for k in kept) for name in ("names", "units", "kinds")
    }
    chosen |= {name: getattr(found, name)[np.array(kept)] for name in ("value", "limit", "margin", "s")}
    return Margins(**chosen)


def _facts(equilibrium: Equilibrium, found: Margins, multiple: float) -> list[Fact]:
    rod = equilibrium.scene.rod
    s, strain, tension = (np.asarray(x) for x in (equilibrium.s, equilibrium.axial_strain, equilibrium.tension))
    length = float(rod.length)
    measured = {name: (float(found.value[k]), float(found.s[k])) for k, name in enumerate(found.names)}
    facts = [
        Fact("free length", length, "m", note="unstretched"),
        Fact("stretched length", float(np.trapezoid(1 + strain, s)), "m"),
    ]
    if "bend radius" in measured:
        radius, place = measured["bend radius"]
        diameter = float(found.limit[found.names.index("bend radius")]) / multiple
        note = f"{radius / diameter:.3g} times the outer diameter" if np.isfinite(radius) else "straight"
        # Where the radius varies, the place goes with it as much as with the curvature.
        note += _somewhere(equilibrium) if np.isfinite(radius) and not isinstance(rod.radius, Along) else ""
        facts.append(Fact("smallest inside bend radius", *_finite(radius, "m", place), note=note))
    else:
        arclengths, curvature = (np.asarray(x) for x in curvature_along(equilibrium))
        most = int(np.argmax(curvature))
        is_straight = curvature[most] * length <= STRAIGHT
        radius = np.inf if is_straight else 1 / float(curvature[most])
        note = "straight" if is_straight else f"of the centerline{_somewhere(equilibrium)}"
        facts.append(Fact("smallest bend radius", *_finite(radius, "m", arclengths[most]), note=note))
    clearances = {name: at for name, at in measured.items() if _limit_of(name) == "clearance"}
    if clearances:
        nearest = min(clearances, key=lambda name: clearances[name][0])
        facts.append(
            Fact(
                CLEARANCE,
                *_finite(clearances[nearest][0], "m", clearances[nearest][1]),
                note=nearest.removeprefix("clearance "),
            )
        )
    most, least = int(np.argmax(tension)), int(np.argmin(tension))
    facts += [
        Fact("largest twist rate", *_finite(measured["twist"][0], "rad/m", measured["twist"][1])),
        Fact("total twist", float(equilibrium.total_twist), "rad"),
        Fact("largest strain", *_finite(measured["strain"][0], "", measured["strain"][1]), note="of either sign"),
        _axial(float(tension[most]), float(s[most]), "largest tension", "least compression"),
        _axial(float(tension[least]), float(s[least]), "least tension", "largest compression"),
        Fact("elastic energy", float(equilibrium.elastic_energy), "J"),
        Fact("mass", float(rod.mean_mass_per_length) * length, "kg"),
        _stiffness(equilibrium),
        *_errors(equilibrium),
    ]
    return facts


def _axial(force: float, s: float, tension: str, compression: str) -> Fact:
    """A tension, or where it is negative the compression."""
    return Fact(compression if force < 0 else tension, abs(force), "N", s)


def _somewhere(equilibrium: Equilibrium) -> str:
    """Where the largest curvature may be within its error."""
    first, last = np.asarray(most_curved(equilibrium))
    if not (bool(equilibrium.converged) and np.isfinite(first)):
        return ""
    return f", within its error between s = {1e3 * first:.4g} and {1e3 * last:.4g} mm"


def _finite(value: float, unit: str, s: float) -> tuple[float | None, str, float | None]:
    return value if np.isfinite(value) else None, unit, float(s) if np.isfinite(value) else None


def _stiffness(equilibrium: Equilibrium) -> Fact:
    name = "lowest eigenvalue"
    reasons = {
        "not under loads without a potential": not has_potential(equilibrium.scene),
        "not of the continuum": equilibrium.discretization == "continuum",
        "not of what is no equilibrium": not bool(equilibrium.converged),
    }
    reason = next((reason for reason, holds in reasons.items() if holds), None)
    if reason is not None:
        return Fact(name, None, "N", note=reason)
    note = "stiffness of the softest motion" + ("" if bool(equilibrium.stable) else ": NOT stable")
    return Fact(name, float(lowest_mode(equilibrium).stiffness), "N", note=note)


def _errors(equilibrium: Equilibrium) -> list[Fact]:
    """Those of the mesh, as estimated: of the shape, and of what limits and supports are told by."""
    found = estimated_errors(equilibrium)
    shape = float(np.max(np.linalg.norm(np.asarray(found.nodes), axis=-1)))
    if not np.isfinite(shape):
        return [Fact("estimated error of the shape", None, "m")]
    segments = equilibrium.s.shape[-1] - 1
    length = float(equilibrium.scene.rod.length)
    note = f"{shape:.0e} of the length, on {segments} segments"
    return [
        Fact("estimated error of the shape", shape * length, "m", note=note),
        Fact("estimated error of the forces", float(found.force), "", note="of the largest force in the cable"),
        Fact(
            "estimated error of the moments",
            float(equilibrium.moment_error),
            "",
            note="of the largest moment in the cable",
        ),
        Fact("estimated error of the smallest bend radius", float(found.curvature), "", note="of the radius"),
    ]
