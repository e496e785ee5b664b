"""The softest motion of an equilibrium."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rodjax.checks import instance, is_known, whole_number
from rodjax.discretization.cells import JointCells
from rodjax.discretization.form import Form, Linearization, Point
from rodjax.discretization.framed import FrameForm
from rodjax.discretization.framed_curve import FramedCurve, cells_of
from rodjax.discretization.framed_error import framed_on_elements
from rodjax.discretization.motion import Motion
from rodjax.discretization.nodal_forms import NodalFrames
from rodjax.discretization.sliding import SlidingForm, SlidingPoint
from rodjax.linalg.saddle_point import factor
from rodjax.model.along import Along
from rodjax.model.scene import nondimensional, slides
from rodjax.model.summaries import range_text
from rodjax.paths.harness_modes import HarnessMode, harness_mode
from rodjax.programs.answers import one_answer
from rodjax.programs.compilation import compiled
from rodjax.solving.harness_result import HarnessEquilibrium
from rodjax.solving.result import Equilibrium, slopes
from rodjax.solving.result_form import free_form_and_point, over_leading_axes
from rodjax.solving.result_summary import motion_text
from rodjax.solving.stability import softest
from rodjax.solving.status import Status


class Mode(eqx.Module):
    """The motion in which an equilibrium is softest; of several ones along a leading axis `...`.

    - `stiffness` [...] N: the second variation of the energy in this motion, by the integral along the rod of the
      squared change of the tangent. Negative where the energy falls, zero for a neutral motion. A straight strut
      loses as much of it as it is pressed. A rod that slides by its length through a clip counts as one that turns by
      1 rad. Derivatives by the scene are exact, of two motions equally soft those of one
    - `displacement` [..., n+1, 3] of the places of the rod at the nodes, the largest 1; taken as fixed by derivatives
    """

    stiffness: Float[Array, "..."]
    displacement: Float[Array, "... n+1 3"]

    def __str__(self) -> str:
        """The stiffness, and of a single motion where along the rod it is largest, and which way."""
        if not is_known(self):
            return "Mode: values not known inside jax.jit, vmap or grad"
        told = f"Mode: stiffness {range_text(self.stiffness, 'N')}"
        return told if np.ndim(self.stiffness) else f"{told}, largest motion {motion_text(self.displacement)}"


@one_answer
def lowest_mode(equilibrium: Equilibrium | HarnessEquilibrium) -> Mode | HarnessMode:
    """The lowest eigenvalue of the energy's second variation at an equilibrium under its supports, and its motion.

    Motions out of a plane in which the rod lies count too. The metric is that of the tangents, or of the frames
    where these are unknown, which spin too: eigenvalues are in N, `EI/L^2` in nondimensional form. O(n). Of a harness
    a `HarnessMode`, of all rods and joints together. A rod slides through its sliding clips in the
    motion; where one holds its direction, sliding has no energy of its own, and the eigenvalue is that of the
    linearised equilibrium.

    Raises `TypeError` for anything but an equilibrium, `ValueError` for one of the continuum or under loads without a
    potential, and for several of a harness, or one with contact between rods or sliding clips.
    """
    instance(equilibrium, "equilibrium", (Equilibrium, HarnessEquilibrium))
    if isinstance(equilibrium, HarnessEquilibrium):
        if equilibrium.energy.ndim:
            raise ValueError(f"equilibrium must be a single one, got a stack of shape {equilibrium.energy.shape}")
        if not equilibrium.harness.has_potential:
            raise ValueError(
                "equilibrium must have a potential: dead moments, couples along a rod and follower loads have none"
            )
        if equilibrium.harness.contact:
            raise ValueError("equilibrium must be of a harness with contact=False: with it no softest motion is sought")
        if any(map(slides, equilibrium.harness.scenes)):
            raise ValueError(
                "equilibrium must be of a harness without sliding clips: with them no softest motion is sought"
            )
        return harness_mode(equilibrium)
    if equilibrium.discretization == "continuum":
        raise ValueError("equilibrium must be of elements or finite differences, got one of the continuum")
    return _lowest_mode(equilibrium)


@one_answer
def squared_frequencies(equilibrium: Equilibrium, count: int = 6) -> np.ndarray:
    """Squares of the lowest angular frequencies of small vibrations [1/s^2], (count,) complex, by magnitude.

    All real and positive: the equilibrium is stable. A negative one: it is left without vibration (divergence); a
    complex pair: by vibrations that grow (flutter). Under follower loads and couples, which have no potential, this is
    what tells stability. The inertia of the sections against turning is left out. O(n^3), eager only.

    Raises `ValueError` where the solve did not converge or the rod has no mass, or where its tangents suffice (see
    `rodjax.Rod`): its loads have a potential or are dead moments, and `Equilibrium.index` and `stable` tell.
    """
    instance(equilibrium, "equilibrium", Equilibrium)
    if not is_known(equilibrium):
        raise ValueError("equilibrium must hold numbers, got a traced one: call squared_frequencies outside jax.jit")
    if equilibrium.s.ndim > 1:
        raise ValueError(f"equilibrium must be a single one, got a stack of shape {equilibrium.s.shape[:-1]}")
    if not isinstance(equilibrium.state.shape, FramedCurve):
        raise ValueError("equilibrium must be of a rod or loads that need frames along the rod")
    rod = equilibrium.scene.rod
    mass = float(rod.mean_mass_per_length)
    if not mass > 0:
        raise ValueError(f"equilibrium must be of a rod with a mass_per_length, got {mass:g} kg/m")
    if not bool(equilibrium.converged):
        raise ValueError(f"equilibrium must be one: {Status(int(equilibrium.status)).message}")
    flexibility, weights = _flexibility(equilibrium)
    values = np.linalg.eigvals(np.asarray(flexibility) * np.repeat(np.asarray(weights), 3)[None])
    values = values[np.argsort(-np.abs(values))][: whole_number(count, "count", 1, len(values))]
    return float(rod.bending_scale) / (mass * float(rod.length) ** 4) / values.astype(complex)


@compiled
def _flexibility(equilibrium: Equilibrium) -> tuple[Float[Array, "3n 3n"], Float[Array, "n"]]:
    """The displacements of the nodes under forces on them, nondimensional, and the mass that each node stands for."""
    scene, state = nondimensional(equilibrium.scene)[0], equilibrium.state
    assert isinstance(state.shape, FramedCurve)
    cells, point = cells_of(scene, state.shape), state.point(equilibrium.total_twist)
    if isinstance(cells, JointCells):
        on_elements, point = framed_on_elements(FrameForm.of(scene, cells), point)
        cells = on_elements.field
    # Forces on nodes are right sides where these have places of their own.
    form = NodalFrames.of(scene, cells)
    point = form.begun(point, state.shape.nodes, state.pressures, state.friction)
    here = form.linearized(point)
    # A rod that can spin, or turn as a whole, is held softly.
    factors = factor(form.regular(here.system))
    count = 3 * len(form.field.s)
    before = len(here.constraint_residual) - form.layout.size - count

    def moved(force: Float[Array, "3n"]) -> Float[Array, "3n"]:
        given = jnp.zeros_like(here.constraint_residual).at[before : before + count].set(force)
        _, multipliers = factors.solve(jnp.zeros_like(here.gradient), given)
        return form.others(multipliers).displacements.reshape(-1)

    is_free = jnp.repeat(jnp.where(form.is_held, 0.0, 1.0).astype(here.constraint_residual.dtype), 3)
    forces = jnp.diag(is_free)
    s = jnp.concatenate([form.field.s[:1], (form.field.s[1:] + form.field.s[:-1]) / 2, form.field.s[-1:]])
    mass = form.scene.rod.mass_per_length
    masses = mass.integral(s) if isinstance(mass, Along) else s
    return jax.vmap(moved)(forces).T * is_free[:, None], jnp.diff(masses)


@over_leading_axes
def _lowest_mode(equilibrium: Equilibrium) -> Mode:
    form, point = free_form_and_point(equilibrium)
    if not form.has_potential:
        raise ValueError(
            "equilibrium must have a potential: dead moments on a free end, couples along the rod and follower loads "
            "have none"
        )
    here = form.linearized(point)
    mode = mode_of(form, point, here, *softest(form, point, here), equilibrium)
    return eqx.tree_at(lambda mode: mode.displacement, mode, replace_fn=jax.lax.stop_gradient)


def mode_of(
    form: Form,
    point: Point,
    here: Linearization,
    stiffness: Float[Array, ""],
    motion: Motion,
    equilibrium: Equilibrium,
) -> Mode:
    """A motion of an equilibrium and its nondimensional stiffness, as a `Mode`."""
    force_change = form.layout.forces(form.force_components(motion.multipliers))

    def moved(amount: Float[Array, ""]) -> tuple[Float[Array, "n+1 3"], Float[Array, "n+1"] | None]:
        if not isinstance(form, SlidingForm):
            there = form.retract(point, here.bases, amount * motion.rotation, amount * force_change)
            return form.nodes(form.edges(there)), None
        assert isinstance(point, SlidingPoint)
        others = form.others(amount * motion.multipliers)
        there = form.retract(point, here.bases, amount * motion.rotation, amount * force_change, others)
        at_arclengths = form.at(there.arclengths)
        return at_arclengths.nodes(at_arclengths.edges(there.inner)), at_arclengths.field.s

    _, (displacement, along) = jax.jvp(moved, (jnp.zeros_like(stiffness),), (jnp.ones_like(stiffness),))
    if along is not None:
        # Nodes go along the rod with the clips.
        displacement -= along[:, None] * slopes(equilibrium)
    largest = jnp.sqrt(jnp.max(jnp.sum(displacement**2, axis=1)))
    return Mode(stiffness * nondimensional(equilibrium.scene)[1].force, displacement / largest)
