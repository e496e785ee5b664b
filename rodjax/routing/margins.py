"""By how much a rod at rest keeps to limits: of each limit the value that decides, where it is, and its margin."""

import dataclasses
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from rodjax.analysis.clearance import POINTS, arclengths_between, radius_at
from rodjax.analysis.curvature import at_nodes, curvature_within, has_sides, within_elements
from rodjax.checks import instance, sequence
from rodjax.discretization.hermite import Curve
from rodjax.geometry.vectors import dot, root
from rodjax.model.along import Value, value_at
from rodjax.model.harness import Harness, scenes_of
from rodjax.model.obstacles import Obstacle, checked_obstacles
from rodjax.model.scene import Scene
from rodjax.paths.modes import lowest_mode
from rodjax.routing.limits import Limits
from rodjax.solving.harness_result import HarnessEquilibrium, Solution, results_of, solved_in
from rodjax.solving.result import Equilibrium, beside_nodes
from rodjax.solving.result_form import over_leading_axes

# What the name of a clearance is told by, before that of the obstacle.
CLEARANCE = "clearance to "
# Steps of the secant method towards the nearest place of a piece of the rod.
NEARER = 6


class Margins(eqx.Module):
    """The margins to limits, one entry for each of the m quantities they limit; of several rods along `...`.

    - `names`: such as "bend radius", "clearance to obstacle 0", "force of clip 0", "moment of start"
    - `units` of value and limit; `kinds`: "least" or "most"
    - `value` [..., m], `limit` [..., m], in SI units; the bend radius is the inside one [m], infinite of a straight rod
    - `margin` [..., m]: the part of the limit that is left, (value - limit)/limit of a least one and the reverse of a
      largest one; of a limit of 0 the difference itself. Not negative where the limit is kept
    - `s` [..., m] m, arclength of the place that decides; not a number where there is none
    """

    names: tuple[str, ...] = eqx.field(static=True)
    units: tuple[str, ...] = eqx.field(static=True)
    kinds: tuple[str, ...] = eqx.field(static=True)
    value: Float[Array, "... m"]
    limit: Float[Array, "... m"]
    margin: Float[Array, "... m"]
    s: Float[Array, "... m"]

    def __str__(self) -> str:
        """One line for each: name, value, limit, margin, place."""
        if self.value.ndim > 1:
            return f"Margins of {', '.join(self.names)} for {np.prod(self.value.shape[:-1])} rods"
        rows = zip(self.names, self.units, self.kinds, self.value, self.limit, self.margin, self.s, strict=True)
        return "\n".join(
            f"{name}: {float(value):.4g} {unit} ({kind} {float(limit):.4g}), margin {100 * float(margin):.1f} %"
            + (f" at s = {float(s):.4g} m" if np.isfinite(s) else "")
            for name, unit, kind, value, limit, margin, s in rows
        )


class Measured(eqx.Module):
    """What a limit is compared with: at each of w places of the rod, or at w = 1, the worst.

    `slack`: smooth, of order 1 and not negative where the limit is kept, for optimisers. `obstacle`: the number of
    the one whose clearance it is.
    """

    name: str = eqx.field(static=True)
    unit: str = eqx.field(static=True)
    is_least: bool = eqx.field(static=True)
    value: Float[Array, "w"]
    limit: Float[Array, "w"]
    slack: Float[Array, "w"]
    s: Float[Array, "w"]
    obstacle: int | None = eqx.field(static=True, default=None)

    @property
    def margin(self) -> Float[Array, "w"]:
        is_finite = jnp.isfinite(self.value)  # not so the radius of a straight rod, whose derivatives are 0
        value = jnp.where(is_finite, self.value, self.limit)
        gap = value - self.limit if self.is_least else self.limit - value
        return jnp.where(is_finite, gap / jnp.where(self.limit == 0, 1.0, self.limit), self.value)


def margins(equilibrium: Solution, limits: Limits, obstacles: Any = (), names: Any = None) -> Margins:
    """The margins of an equilibrium to limits.

    **Arguments:**

    - `equilibrium`: of one scene or of many; or of a harness, each of whose cables the limits are of, and the stability
        that of the whole: names are then as "trunk: bend radius".
    - `limits`: `Limits`.
    - `obstacles`: a list of `Obstacle`, from which `limits.clearance` is kept.
    - `names`: of the obstacles; `None`: "obstacle 0" and so on.

    Each is that of the worst place. Clearance is that of the nearest place of the rod, looked for between each two of
    the nodes and four places between two nodes; curvature is looked at on both sides of the nodes and at four places
    between two of them where the mesh is of elements whose tangents are the unknowns, else at the nodes;
    twist and strain at the nodes, the strain at a clip the mean of both sides. Of rods in clips whose frames are the
    unknowns, curvature, twist and strain on both sides of the nodes.

    Derivatives are those of the worst place, held at its fraction of the mesh, by numbers of the scene, the
    limits and the obstacles; of a straight rod, that of the bend radius is 0.

    Raises `ValueError` or `TypeError` for a limit on what the scene lacks: a radius, clips, obstacles, for obstacles
    without a limit of clearance, and for a stability that `rodjax.lowest_mode` refuses.
    """
    instance(equilibrium, "equilibrium", (Equilibrium, HarnessEquilibrium))
    obstacles, names = checked(equilibrium, limits, obstacles, names)
    found = measured_margins(equilibrium, limits, obstacles)
    labels = [_label(each, names) for each in found]
    value, limit, margin, s = (
        jnp.concatenate(rows, axis=-1)
        for rows in zip(*((each.value, each.limit, each.margin, each.s) for each in found), strict=True)
    )
    return Margins(
        names=tuple(labels),
        units=tuple(each.unit for each in found),
        kinds=tuple("least" if each.is_least else "most" for each in found),
        value=value,
        limit=limit,
        margin=margin,
        s=s,
    )


def _label(each: Measured, names: tuple[str, ...]) -> str:
    """With the obstacle by its name."""
    if each.obstacle is None:
        return each.name
    return f"{each.name[: each.name.rindex(CLEARANCE)]}{CLEARANCE}{names[each.obstacle]}"


def checked(
    subject: Solution | Scene | Harness, limits: Limits, obstacles: Any, names: Any
) -> tuple[tuple[Obstacle, ...], tuple[str, ...]]:
    """The obstacles and their names, where the limits suit them and the rods of an equilibrium, or of a scene or
    harness.
    """
    instance(limits, "limits", Limits)
    rods = scenes_of(subject if isinstance(subject, Scene | Harness) else solved_in(subject), "{}: ")
    obstacles = sequence(obstacles, "obstacles", "Obstacle")
    if obstacles:
        obstacles = checked_obstacles(obstacles)
    if (limits.clearance is not None) != bool(obstacles):
        given = f"got clearance = {limits.clearance} and {len(obstacles)} obstacles"
        raise ValueError(f"limits.clearance must be given where there are obstacles, and only there; {given}")
    if limits.clearance is not None and limits.clearance.ndim and limits.clearance.shape != (len(obstacles),):
        raise ValueError(
            f"limits.clearance must be one number, or one for each of {len(obstacles)} obstacles, "
            f"got {limits.clearance.shape[0]}"
        )
    names = tuple(f"obstacle {k}" for k in range(len(obstacles))) if names is None else names
    names = sequence(names, "names", "names of obstacles")
    if len(names) != len(obstacles) or not all(isinstance(name, str) for name in names) or len({*names}) < len(names):
        raise ValueError(f"names must be {len(obstacles)} different ones, one for each obstacle, got {list(names)}")
    for field in ("bend_radius", "clearance"):
        for name, scene in rods.items():
            if getattr(limits, field) is not None and scene.rod.radius is None:
                raise ValueError(f"{name}limits.{field} must be None for a rod without a radius; rodjax.Rod takes one")
    for field in ("clip_force", "clip_moment"):
        if getattr(limits, field) is not None and not any(scene.clips for scene in rods.values()):
            raise ValueError(f"limits.{field} must be None for a scene without clips")
    return obstacles, names


@over_leading_axes
def measured_margins(equilibrium: Solution, limits: Limits, obstacles: tuple[Obstacle, ...]) -> list[Measured]:
    """Of each limit the worst."""
    return measured(equilibrium, limits, obstacles)


def measured(
    equilibrium: Solution, limits: Limits, obstacles: tuple[Obstacle, ...], everywhere: bool = False
) -> list[Measured]:
    """What the limits of an equilibrium are compared with; `everywhere`: limits along the rod at every place looked
    at, of clearances at the nearest place of every piece between two of these, in place of the worst alone.
    """
    if isinstance(equilibrium, Equilibrium):
        return _measured_of_rod(equilibrium, limits, obstacles, everywhere)
    of_rods = eqx.tree_at(lambda limits: limits.stability, limits, None, is_leaf=lambda x: x is None)
    found = [
        dataclasses.replace(each, name=f"{name}{each.name}")
        for name, rod in results_of(equilibrium).items()
        for each in _measured_of_rod(rod, of_rods, obstacles, everywhere)
    ]
    if limits.stability is not None:
        rods = [rod.scene.rod for rod in equilibrium.values()]
        unit = jnp.mean(jnp.stack([rod.bending_scale / rod.length**2 for rod in rods]))
        found.append(_stability(equilibrium, limits.stability, unit))
    return found


def _stability(equilibrium: Solution, limit: Float[Array, ""], unit: Float[Array, ""]) -> Measured:
    stiffness = lowest_mode(equilibrium).stiffness
    return _single("stability", "N", True, stiffness, limit, (stiffness - limit) / (limit + unit))


def _measured_of_rod(
    equilibrium: Equilibrium, limits: Limits, obstacles: tuple[Obstacle, ...], everywhere: bool
) -> list[Measured]:
    scene = equilibrium.scene
    found = []
    if limits.bend_radius is not None:
        found.append(_bend_radius(equilibrium, limits.bend_radius, everywhere))
    if limits.clearance is not None:
        found += _clearances(equilibrium, limits.clearance, obstacles, everywhere)
    for unit, limit, of_clips in (
        ("N", limits.clip_force, "clip_forces"),
        ("N m", limits.clip_moment, "clip_moments"),
    ):
        if limit is not None:
            kind = of_clips.removeprefix("clip_").removesuffix("s")
            sizes = getattr(equilibrium, of_clips)
            found += [
                _size(f"{kind} of clip {k}", unit, vector, limit, clip.at)
                for k, (clip, vector) in enumerate(zip(scene.clips, sizes, strict=True))
            ]
    for unit, limit, kind in (("N", limits.end_force, "force"), ("N m", limits.end_moment, "moment")):
        if limit is not None:
            for end, s in (("start", equilibrium.s[0]), ("end", equilibrium.s[-1])):
                vector = getattr(equilibrium, f"{end}_{kind}")
                found.append(_size(f"{kind} of {end}", unit, vector, limit, s))
    along = beside_nodes(equilibrium) if has_sides(equilibrium) else equilibrium
    for name, unit, limit, values in (
        ("twist", "rad/m", limits.twist, along.twist),
        ("strain", "", limits.strain, along.axial_strain),
    ):
        if limit is not None:
            found.append(_largest(name, unit, values, limit, along.s, everywhere))
    if limits.stability is not None:
        found.append(_stability(equilibrium, limits.stability, scene.rod.bending_scale / scene.rod.length**2))
    for name, unit, limit, value in (
        ("length", "m", limits.length, scene.rod.length),
        ("mass", "kg", limits.mass, scene.rod.mean_mass_per_length * scene.rod.length),
        ("energy", "J", limits.energy, equilibrium.elastic_energy),
    ):
        if limit is not None:
            found.append(_single(name, unit, False, value, limit, 1 - value / limit))
    return found


def _single(
    name: str,
    unit: str,
    is_least: bool,
    value: Float[Array, ""],
    limit: Float[Array, ""],
    slack: Float[Array, ""],
    s: Float[Array, ""] | None = None,
) -> Measured:
    s = jnp.full_like(value, jnp.nan) if s is None else s
    value, limit, slack, s = (x.astype(value.dtype).reshape(1) for x in (value, limit, slack, s))
    return Measured(name, unit, is_least, value, limit, slack, s)


def _size(name: str, unit: str, vector: Float[Array, "3"], limit: Float[Array, ""], s: Float[Array, ""]) -> Measured:
    squared = dot(vector, vector)
    slack = 1 - squared / limit**2
    return _single(name, unit, False, root(squared), limit, slack, s)


def _largest(
    name: str, unit: str, values: Float[Array, "k"], limit: Float[Array, ""], s: Float[Array, "k"], everywhere: bool
) -> Measured:
    at = _decisive(-jax.lax.stop_gradient(jnp.abs(values)), everywhere)
    chosen = values[at]
    limits = jnp.broadcast_to(limit.astype(chosen.dtype), chosen.shape)
    return Measured(name, unit, False, jnp.abs(chosen), limits, 1 - (chosen / limits) ** 2, s[at])


def _bend_radius(equilibrium: Equilibrium, multiple: Float[Array, ""], everywhere: bool) -> Measured:
    is_of_elements = isinstance(equilibrium.state.shape, Curve)
    s = within_elements(equilibrium) if is_of_elements else at_nodes(equilibrium)[0]
    radius = radius_at(equilibrium.scene.rod, s)
    limit = 2 * multiple.astype(radius.dtype) * radius

    def curvature_at(equilibrium: Equilibrium, at: Int[Array, "w"]) -> Float[Array, "w"]:
        return curvature_within(equilibrium, s[at]) if is_of_elements else at_nodes(equilibrium)[1][at]

    if everywhere:
        at = jnp.arange(len(s))
    else:
        # The search needs no derivatives.
        curvature = curvature_at(jax.lax.stop_gradient(equilibrium), jnp.arange(len(s)))
        at = _decisive(jax.lax.stop_gradient(1 - curvature * (limit + radius)), False)
    curvature, radius, limit = curvature_at(equilibrium, at), radius[at], limit[at]
    # What is left of its curvature is rounding, or what the solver left.
    is_straight = curvature * equilibrium.scene.rod.length <= float(jnp.finfo(curvature.dtype).eps) ** 0.5
    inside = jnp.where(is_straight, jnp.inf, 1 / jnp.where(is_straight, 1.0, curvature) - radius)
    slack = 1 - curvature * (limit + radius)
    return Measured("bend radius", "m", True, inside, limit, slack, s[at])


def _clearances(
    equilibrium: Equilibrium, limit: Float[Array, "..."], obstacles: tuple[Obstacle, ...], everywhere: bool
) -> list[Measured]:
    edges = arclengths_between(equilibrium, np.arange(POINTS + 1) / (POINTS + 1))
    limits = jnp.broadcast_to(limit.astype(edges.dtype), (len(obstacles),))
    # The search needs no derivatives: where the distance is least along the rod, its derivative by the place is 0.
    fixed, fixed_edges, bodies = jax.lax.stop_gradient((equilibrium, edges, obstacles))
    curve = jax.jvp(fixed.position_at, (fixed_edges,), (jnp.ones_like(edges),))
    radius = fixed.scene.rod.radius

    def to(number: int, obstacle: Obstacle) -> Measured:
        fraction, gap = _nearest_in_pieces(bodies[number], radius, fixed_edges, fixed.position_at, *curve)
        at = _decisive(gap, everywhere)
        a, b, fraction = edges[at], edges[at + 1], fraction[at]
        s = a + fraction * (b - a)
        radii = value_at(equilibrium.scene.rod.radius, s, a, b)
        distance = obstacle.distance(equilibrium.position_at(s)) - radii
        limit = jnp.broadcast_to(limits[number], distance.shape)
        slack = (distance - limit) / (2 * radii)
        return Measured(f"{CLEARANCE}obstacle {number}", "m", True, distance, limit, slack, s, number)

    return [to(number, obstacle) for number, obstacle in enumerate(obstacles)]


def _nearest_in_pieces(
    body: Obstacle,
    radius: Value,
    edges: Float[Array, "k+1"],
    position_at: Callable[[Float[Array, "k"]], Float[Array, "k 3"]],
    positions: Float[Array, "k+1 3"],
    slopes: Float[Array, "k+1 3"],
) -> tuple[Float[Array, "k"], Float[Array, "k"]]:
    """Where each piece of a rod between two arclengths is nearest to a body, as a fraction of the piece, and how near.

    Where the distance falls at its start and rises at its end, its least is where the derivative is 0, found by the
    secant method within a bracket; else it is that of the nearer end.
    """
    a, b = edges[:-1], edges[1:]
    h = b - a
    radii = value_at(radius, a, a, b), value_at(radius, b, a, b)
    taper = (radii[1] - radii[0]) / h

    def gap(points: Float[Array, "m 3"], along: Float[Array, "m 3"]) -> tuple[Float[Array, "m"], Float[Array, "m"]]:
        return jax.jvp(body.distance, (points,), (along,))

    distance, rate = gap(positions, slopes)
    ends = distance[:-1] - radii[0], distance[1:] - radii[1]
    falls, rises = rate[:-1] - taper, rate[1:] - taper
    has_least = (falls < 0) & (rises > 0)

    def closer(_: Any, state: tuple[Float[Array, "k"], ...]) -> tuple[Float[Array, "k"], ...]:
        low, high, before, rate_before, f, rate, best, least_rate = state
        low, high = jnp.where(rate < 0, f, low), jnp.where(rate < 0, high, f)
        change = rate - rate_before
        ahead = f - rate * (f - before) / jnp.where(change == 0, 1.0, change)
        ahead = jnp.where((ahead > low) & (ahead < high), ahead, (low + high) / 2)
        # Where the derivative is 0 already, it stays.
        ahead = jnp.where(rate == 0, f, ahead)
        rate_ahead = gap(*jax.jvp(position_at, (a + ahead * h,), (jnp.ones_like(f),)))[1] - taper
        # From where the derivative is a rounding of 0 the next step may lead anywhere in the bracket.
        is_better = jnp.abs(rate_ahead) < least_rate
        best, least_rate = jnp.where(is_better, ahead, best), jnp.where(is_better, jnp.abs(rate_ahead), least_rate)
        return low, high, f, rate, ahead, rate_ahead, best, least_rate

    zero, one = jnp.zeros_like(h), jnp.ones_like(h)
    *_, f, _ = jax.lax.fori_loop(0, NEARER, closer, (zero, one, zero, falls, one, rises, one, jnp.abs(rises)))
    lowest = body.distance(position_at(a + f * h)) - radii[0] - f * (radii[1] - radii[0])
    f = jnp.where(has_least, f, jnp.where(ends[1] < ends[0], 1.0, 0.0))
    return f, jnp.where(has_least, lowest, jnp.minimum(*ends))


def _decisive(values: Float[Array, "k"], everywhere: bool) -> Int[Array, "w"]:
    """All places, or the one where the values are least."""
    return jnp.arange(len(values)) if everywhere else jnp.argmin(values)[None]
