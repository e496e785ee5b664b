"""What a rod of a harness gives to the bodies in which it ends: derivatives by the motions of these.

A motion (u, r) of a body: displacement in parts of a length, and rotation vector about global axes. It carries the end
of a rod to position + length u + exp(r) arm, and turns its frame by r. L depends on positions through the spans alone,
linearly; its derivatives by the frame of an end are those of a linearisation in which the ends may turn
(`Form.released`). Where nodes have positions of their own, the ends of that one may move too.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from rodjax.discretization.contact_gaps import curvatures, distances_and_normals
from rodjax.discretization.form import EndTurn, Form, Linearization
from rodjax.discretization.layout import SpanForces
from rodjax.discretization.nodal import MERIT_COMPLIANCE, NodalForm
from rodjax.discretization.node_contacts import GAP_WEIGHT, LEAST_RELAXED, LIES_ON
from rodjax.discretization.sliding import SlidingForm
from rodjax.discretization.sliding_point import SlidingLinearization, SlidingPoint
from rodjax.linalg.bordered import BorderedSystem
from rodjax.linalg.chain import ChainSystem
from rodjax.linalg.saddle_point import SaddlePointSystem
from rodjax.model.harness import rotated
from rodjax.model.supports import Clamp
from rodjax.units import Units

ENDS = (0, -1)


class RodInBodies(NamedTuple):
    """One rod, with the poses of the bodies at its ends, `length` the unit of their displacements; `touches`: whether
    obstacles push the body at an end.
    """

    form: Form
    units: Units
    is_joint: Bool[Array, "2"]
    frame: Float[Array, "2 3 3"]
    offset: Float[Array, "2 3"]
    position_of_body: Float[Array, "2 3"]
    frame_of_body: Float[Array, "2 3 3"]
    length: Float[Array, ""]
    touches: Bool[Array, "2"]

    def form_at(self, motions: Float[Array, "2 6"] | None = None) -> Form:
        """The form with its ends at the poses of the bodies after these motions."""
        scene, form = self.form.scene, self.form
        places, bodies, ends = self.position_of_body, self.frame_of_body, []
        if motions is not None:
            places, bodies = places + self.length * motions[:, :3], rotated(bodies, motions[:, 3:])
        places += (bodies @ self.offset[..., None])[..., 0]
        places, frames = (places - self.units.origin[None]) / self.units.length, bodies @ self.frame
        for end, support in enumerate((scene.start, scene.end)):
            if isinstance(support, Clamp):
                place = jnp.where(self.is_joint[end], places[end], support.position)
                frame = jnp.where(self.is_joint[end], frames[end], support.frame)
                support = eqx.tree_at(lambda clamp: (clamp.position, clamp.frame), support, (place, frame))
            ends.append(support)
        if isinstance(form, SlidingForm):
            return form.between((ends[0], ends[1]), self.touches)
        scene = eqx.tree_at(lambda scene: (scene.start, scene.end), scene, tuple(ends))
        form = eqx.tree_at(lambda form: form.scene, form, scene)
        return dataclasses.replace(form, pushed=self.touches) if isinstance(form, NodalForm) else form

    def arm(self, end: int) -> Float[Array, "3"]:
        """From the body to the end of the rod, in the unit of length of the rod."""
        return self.frame_of_body[end] @ self.offset[end] / self.units.length

    def carried(self, end: int) -> Float[Array, "3 6"]:
        """The derivative of the position of an end by the motion of its body."""
        x, y, z = self.arm(end)
        zero = jnp.zeros_like(x)
        turning = jnp.stack([jnp.stack([zero, z, -y]), jnp.stack([-z, zero, x]), jnp.stack([y, -x, zero])])
        shift = self.length / self.units.length * jnp.eye(3, dtype=x.dtype)
        return jnp.concatenate([shift, turning], axis=1)


class Coupling(NamedTuple):
    """Derivatives of a rod's L by the motions of its ends: first, second, and of its gradient and constraint residual;
    those of the gaps of contacts apart, `None` without obstacles. `of_nodes`: how rotation and position of the node at
    each end follow, `None` where nodes have no positions. `of_rotations`, `of_multipliers`: the derivatives of the
    first ones by rotations and multipliers, where these are not `of_gradient` and `of_constraints`.
    """

    first: Float[Array, "12"]
    second: Float[Array, "12 12"]
    of_gradient: Float[Array, "b m 12"]
    of_constraints: Float[Array, "k 12"]
    of_gaps: Float[Array, "r n+1 12"] | None
    of_nodes: Float[Array, "2 b+3 6"] | None
    of_multipliers: Float[Array, "k 12"] | None = None
    of_rotations: Float[Array, "b m 12"] | None = None

    @property
    def is_symmetric(self) -> bool:
        return self.of_multipliers is None and self.of_rotations is None

    @property
    def by_rotations(self) -> Float[Array, "b m 12"]:
        return self.of_gradient if self.of_rotations is None else self.of_rotations

    @property
    def by_multipliers(self) -> Float[Array, "k 12"]:
        return self.of_constraints if self.of_multipliers is None else self.of_multipliers


class EndContacts(NamedTuple):
    """Of the bodies with each obstacle, where a rod ends in them: gaps as a step is to see them and as they are, their
    rates by the motions of the body, and pressures.
    """

    gaps: Float[Array, "o 2"]
    found: Float[Array, "o 2"]
    rates: Float[Array, "o 2 6"]
    pressures: Float[Array, "o 2"]
    is_closed: Bool[Array, "o 2"]

    @property
    def residual(self) -> Float[Array, ""]:
        """Of a gap and a pressure one is zero, none is negative."""
        weighted = GAP_WEIGHT * self.found
        return jnp.max(jnp.abs(jnp.where(self.pressures < weighted, self.pressures, weighted)), initial=0.0)


def end_gaps(rod: RodInBodies, form: NodalForm) -> tuple[Float[Array, "o 2"], Float[Array, "o 2 3"]]:
    """Gaps between obstacles and the ends of a rod in bodies that these push, else 1, and the directions of growth."""
    if not form.scene.obstacles:
        nothing = jnp.zeros((0, 2, 3), form.field.s.dtype)
        return nothing[..., 0], nothing
    distances, normals = distances_and_normals(form.scene, _places(form))
    radius = form.radius[np.array([0, -1])]
    touches = rod.touches[None]
    return jnp.where(touches, distances - radius[None], 1.0), jnp.where(touches[..., None], normals, 0.0)


def _at_ends(form: NodalForm | SlidingForm) -> NodalForm:
    """At the ends of a rod it does not matter where it passes its clips."""
    nodal = form.first if isinstance(form, SlidingForm) else form
    assert isinstance(nodal, NodalForm)
    return nodal


def _places(form: NodalForm) -> Float[Array, "2 3"]:
    """Of clamped ends."""
    nowhere = jnp.zeros(3, form.field.s.dtype)
    ends = (form.scene.start, form.scene.end)
    return jnp.stack([end.position if isinstance(end, Clamp) else nowhere for end in ends])


def end_contact_energy(
    rod: RodInBodies, form: NodalForm | SlidingForm, here: EndContacts, change: Float[Array, "o 2"]
) -> Float[Array, ""]:
    """As `NodalForm.contact_energy`, from where a step begins that changes the pressures."""
    gaps, _ = end_gaps(rod, _at_ends(form))
    pushing = here.pressures + change - (gaps + here.gaps - here.found) / MERIT_COMPLIANCE
    return MERIT_COMPLIANCE / 2 * jnp.sum(jnp.where(pushing > 0, pushing, 0.0) ** 2)


def end_contact_rate(here: EndContacts, change: Float[Array, "o 2"], motions: Float[Array, "2 6"]) -> Float[Array, ""]:
    """How fast that changes as such a step begins."""
    pushing = here.pressures + change - here.gaps / MERIT_COMPLIANCE
    return -jnp.sum(jnp.where(pushing > 0, pushing, 0.0) * jnp.einsum("oei,ei->oe", here.rates, motions))


def end_contacts(
    rod: RodInBodies, form: NodalForm | SlidingForm, pressures: Float[Array, "o 2"], coupling: Coupling
) -> tuple[EndContacts, Coupling]:
    """And with what these contacts add to L."""
    form = _at_ends(form)
    gaps, normals = end_gaps(rod, form)
    relaxed = jnp.where(gaps < -LEAST_RELAXED, -gaps / 2, 0.0)
    carried = jnp.stack([rod.carried(0), rod.carried(1)])
    rates = jnp.einsum("oec,eci->oei", normals, carried)
    pulls = -jnp.einsum("oe,oec->ec", pressures, normals)
    curved = jnp.zeros((2, 3, 3), pulls.dtype)
    if form.scene.obstacles:
        curved -= jnp.einsum("oe,oecd->ecd", pressures, curvatures(form.scene, _places(form)))
    first = jnp.einsum("ec,eci->ei", pulls, carried)
    second = jnp.einsum("eci,ecd,edj->eij", carried, curved, carried)
    second = second.at[:, 3:, 3:].add(jnp.stack([lifted(pulls[e], rod.arm(e)) for e in range(2)]))
    at_ends = EndContacts(
        gaps + relaxed, gaps, rates, pressures, (pressures > GAP_WEIGHT * (gaps + relaxed)) | (gaps + relaxed < LIES_ON)
    )
    coupling = coupling._replace(
        first=coupling.first + first.reshape(12), second=coupling.second + jax.scipy.linalg.block_diag(*second)
    )
    return at_ends, coupling


def lifted(pull: Float[Array, "3"], arm: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """The second derivative of pull . exp(r) arm: exp(r) arm = arm + r x arm + r x (r x arm) / 2."""
    both = pull[:, None] * arm[None] + arm[:, None] * pull[None]
    return both / 2 - (pull @ arm) * jnp.eye(3, dtype=pull.dtype)


def linearized_with_ends(rod: RodInBodies, form: Form, point: Any) -> tuple[Linearization, Coupling]:
    """The linearisation of a rod, whose form has its ends where they are, and what couples it to these."""
    if isinstance(form, SlidingForm):
        here, coupled = linearized_with_ends(rod, form.at(point.arclengths), point.inner)
        return form.with_arclengths(point, here), _with_arclengths(rod, point, coupled)
    released = form.released(point)
    return held(form, released), coupling(rod, form, point, released)


def _with_arclengths(rod: RodInBodies, point: SlidingPoint, coupled: Coupling) -> Coupling:
    """Where the rod slides through clips. What these apply along the rod knows of the ends by forces and rotations
    alone, but the mesh goes along with the clips, and what is left at the ends with it: no symmetry.
    """

    def energy(motions: Float[Array, "12"], arclengths: Float[Array, "j"]) -> Float[Array, ""]:
        form = rod.form_at(motions.reshape(2, 6))
        return form.lagrangian(form.holding(dataclasses.replace(point, arclengths=arclengths)))[0]

    nowhere = jnp.zeros_like(coupled.first)
    by_arclengths = jax.jacfwd(lambda arclengths: jax.grad(energy)(nowhere, arclengths))(point.arclengths)
    before = jnp.zeros_like(by_arclengths.T)
    return coupled._replace(
        of_constraints=jnp.concatenate([before, coupled.of_constraints]),
        of_multipliers=jnp.concatenate([by_arclengths.T, coupled.by_multipliers]),
    )


def solved_with_columns(
    solve: Callable[[Array, Array], tuple[Array, Array]], right: tuple[Array, Array], columns: tuple[Array, Array]
) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """Solutions for a right side, and for those of `Coupling`, which stand along a last axis: side by side, so that a
    program has the solution once.
    """
    sides = (jnp.concatenate([side[..., None], more], axis=-1) for side, more in zip(right, columns, strict=True))
    x, y = jax.vmap(solve, (-1, -1), -1)(*sides)
    return (x[..., 0], y[..., 0]), (x[..., 1:], y[..., 1:])


def sliding_along(here: SlidingLinearization, coupled: Coupling) -> Coupling:
    """What moves a rod beside obstacles: the motions of its ends, and after these the arclengths of its sliding clips,
    which stay as they are where it does not slide yet.
    """
    system, slides = here.system, here.slides
    assert isinstance(system, BorderedSystem)
    chain = system.inner
    assert isinstance(chain, ChainSystem)
    j = len(here.arclengths)
    columns, rows = (
        tuple(jnp.where(slides, jnp.moveaxis(part, 0, -1), 0.0) for part in parts)
        for parts in (system.columns, system.rows)
    )
    identity = jnp.eye(j, dtype=system.corner.dtype)
    by_ends = jnp.where(slides, coupled.by_multipliers[:j].T, 0.0)
    second = jnp.pad(coupled.second, ((0, j), (0, j)))
    second = second.at[:12, 12:].set(by_ends).at[12:, 12:].set(jnp.where(slides, system.corner, identity))
    # Which contacts are closed is sought.
    first, size = len(chain.compliance), chain.contacts.is_closed.size
    contacts = slice(first, first + size)
    of_gaps = None
    if coupled.of_gaps is not None:
        assert here.gap_rates is not None
        by_arclengths = jnp.where(slides, jnp.moveaxis(here.gap_rates, 0, -1), 0.0)
        of_gaps = jnp.concatenate([coupled.of_gaps, by_arclengths], axis=2)
    of_constraints = jnp.concatenate([coupled.of_constraints[j:], columns[1].at[contacts].set(0.0)], axis=1)
    return Coupling(
        jnp.concatenate([coupled.first, jnp.where(slides, here.constraint_residual[:j], 0.0)]),
        second,
        jnp.concatenate([coupled.of_gradient, columns[0]], axis=2),
        of_constraints,
        of_gaps,
        coupled.of_nodes,
        jnp.concatenate([coupled.by_multipliers[j:], rows[1]], axis=1),
        jnp.concatenate([coupled.by_rotations, rows[0]], axis=2),
    )


def held(form: Form, released: Linearization) -> Linearization:
    """With the ends held that clamps hold."""
    free, system = free_points(form, released), released.system
    gradient, bases = released.gradient * free[None], released.bases * free[None, None]
    released = dataclasses.replace(released, bases=bases, gradient=gradient)
    if isinstance(system, ChainSystem):
        nodes = free[::2]
        system = system.holding(free, nodes)
        first, contacts, balance, gaps = system.split(released.constraint_residual)
        parts = [part.reshape(-1) for part in (first, contacts, balance * nodes[:, None], gaps)]
        return dataclasses.replace(released, system=system, constraint_residual=jnp.concatenate(parts))
    assert isinstance(system, SaddlePointSystem), "rods that slide have forms at fixed arclengths"
    identity = np.eye(len(system.diagonal), dtype=free.dtype)[..., None]
    blocks = free[None, None]
    across = system.across
    if across is not None:
        across = across * blocks[..., 2::2] * blocks[..., 0:-1:2]
    system = SaddlePointSystem(
        system.diagonal * blocks + identity * (1 - blocks),
        system.lower * blocks[..., 1:] * blocks[..., :-1],
        system.border * blocks,
        system.compliance,
        across=across,
    )
    return dataclasses.replace(released, system=system)


def free_points(form: Form, released: Linearization) -> Float[Array, "m"]:
    """1 at points that may turn, 0 at clamped ends."""
    free = np.ones(released.gradient.shape[1])
    for end, support in zip(ENDS, (form.scene.start, form.scene.end), strict=True):
        if isinstance(support, Clamp):
            free[end] = 0.0
    return jnp.asarray(free, released.gradient.dtype)


def coupling(rod: RodInBodies, form: Form, point: Any, released: Linearization) -> Coupling:
    (b, m), dtype, system = released.gradient.shape, released.gradient.dtype, released.system
    ends = [
        _Turning(number, end, form.end_turn(point, released, end))
        for number, (end, support) in enumerate(zip(ENDS, (form.scene.start, form.scene.end), strict=True))
        if isinstance(support, Clamp)
    ]
    # By rotations of the frames, and where ends have positions of their own by these: columns for each end.
    width = 6 if isinstance(system, ChainSystem) else 3
    columns = jnp.zeros((b, m, 2, width), dtype)
    others = jnp.zeros((len(released.constraint_residual), 2, width), dtype)
    for number, end, turn in ends:
        columns = columns.at[:, end, number, -3:].set(turn.rotation)
        if isinstance(system, ChainSystem):
            others = others.at[_rows_of(system, end), number].set(rod.carried(number))
    of_nodes = None
    if isinstance(system, ChainSystem):
        of_nodes = jnp.zeros((2, b + 3, 6), dtype)
        for number, _, turn in ends:
            of_nodes = of_nodes.at[number, :b, 3:].set(turn.rotation).at[number, b:].set(rod.carried(number))
    columns, others = columns.reshape(b, m, 2 * width), others.reshape(-1, 2 * width)
    turned, lacking = jax.vmap(system.times, (-1, -1), -1)(columns, others)
    bent = jnp.einsum("bmk,bml->kl", columns, turned)
    of_gaps = of_rotations = of_multipliers = None
    if isinstance(system, ChainSystem):
        bent += others.T @ lacking
        if system.loads is not None:
            transposed = jax.linear_transpose(system.times, columns[..., 0], others[..., 0])
            of_rotations, of_multipliers = jax.vmap(lambda *parts: transposed(parts), (-1, -1), -1)(columns, others)
            of_rotations = of_rotations * free_points(form, released)[None, :, None]
            of_multipliers, _ = _without_gaps(system, ends, columns, others, of_multipliers)
        lacking, of_gaps = _without_gaps(system, ends, columns, others, lacking)
    bent = bent.reshape(2, width, 2, width)
    turned = turned * free_points(form, released)[None, :, None]
    before = 6 - width
    first = jnp.zeros((2, 6), dtype)
    second = jnp.zeros((2, 6, 2, 6), dtype).at[:, before:, :, before:].set(bent)
    of_gradient = jnp.pad(turned.reshape(b, m, 2, width), ((0, 0), (0, 0), (0, 0), (before, 0)))
    of_constraints = jnp.pad(lacking.reshape(-1, 2, width), ((0, 0), (0, 0), (before, 0)))
    pulls = form.end_forces(point, form.fields_on_elements(point))
    for number, end, turn in ends:
        arm, carried = rod.arm(number), rod.carried(number)
        pull = (1.0 if end else -1.0) * pulls[end]
        by_turn = turn.first + turn.rotation.T @ released.gradient[:, end]
        first = first.at[number].set(pull @ carried).at[number, 3:].add(by_turn)
        second = second.at[number, 3:, number, 3:].add(turn.second + lifted(pull, arm))
        if not isinstance(system, ChainSystem):
            spans = _spans_by_position(form, end, dtype)
            of_constraints = of_constraints.at[len(of_constraints) - len(spans) :, number].add(spans @ carried)
        if turn.torque is not None:
            of_constraints = of_constraints.at[0, number, 3:].add(turn.torque)
    return Coupling(
        first.reshape(12),
        second.reshape(12, 12),
        of_gradient.reshape(b, m, 12),
        of_constraints.reshape(-1, 12),
        of_gaps,
        of_nodes,
        of_multipliers,
        of_rotations,
    )


def _rows_of(system: ChainSystem, end: int) -> slice:
    """Those of the place of the node at an end among the multipliers."""
    nodes = len(system.held)
    before = len(system.compliance) + system.contacts.is_closed.size + (3 * (nodes - 1) if end else 0)
    return slice(before, before + 3)


def _without_gaps(
    system: ChainSystem, ends: list["_Turning"], columns: Array, others: Array, lacking: Array
) -> tuple[Float[Array, "k 12"], Float[Array, "r n+1 12"] | None]:
    """The rows of a rod whose ends are held, but for contacts, and the rates of the gaps of these."""
    for _, end, _ in ends:
        lacking = lacking.at[_rows_of(system, end)].set(0.0)
    size = system.contacts.is_closed.size
    if not size:
        return lacking, None
    rates = jax.vmap(lambda x, y: system.contacts.rates(x, system.split(y)[2]), (-1, -1), -1)(columns, others)
    first = len(system.compliance)
    return lacking.at[first : first + size].set(0.0), rates


class _Turning(NamedTuple):
    """A clamped end: its number, its place among the points, and what turns with its frame."""

    number: int
    end: int
    turn: EndTurn


def _spans_by_position(form: Form, end: int, dtype: Any) -> Float[Array, "size 3"]:
    """The derivatives of the spans by the position of an end."""
    layout, sign = form.layout, 1.0 if end else -1.0
    assert isinstance(layout, SpanForces)
    direction = np.zeros((3, layout.parts, 3))
    direction[:, end] = sign * np.eye(3)
    return jax.vmap(layout.components, -1, -1)(jnp.asarray(direction, dtype))
