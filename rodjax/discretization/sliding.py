"""A rod that slides through clips: the arclengths at which it passes them are unknowns beside those of its form.

At given arclengths s a scene has a form (`forms.form_of`) on a mesh whose nodes at the clips go along with them. Asked
for is that no sliding clip pulls along the rod, R . t = 0: one more row for each, and one more column, the derivatives
of all other rows by s, of which the nodes that move are a part (`linalg.bordered`). The energy falls by as much as
a clip pulls, dW/ds = -R . t (1 + e), but for the error of the mesh: so row and column are nearly the same, and the
negative eigenvalues of the complement add to those at given arclengths.

A step is judged by the energy, less what its slope by s is beyond -R . t at the point where the step begins: so what
is found is free of axial forces to the last digit, on any mesh. Where a clip holds the tangent, this is
all but the error of the mesh: the moment jumps there, and what slides would take its work (Bigoni et al. 2015,
"Eshelby-like forces acting on elastic structures"). R has the share that a contact within an element beside the clip
has at its node: without it rods slid out of their clips on meshes too coarse for such contacts.

Beside obstacles the contacts of a step are sought together with the arclengths (`linalg.unilateral_border`).
"""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from rodjax.discretization.form import NEUTRAL, Form, HeldLoads, Linearization
from rodjax.discretization.forms import form_of
from rodjax.discretization.moving_mesh import MovingMeshForm
from rodjax.discretization.nodal import NodalForm
from rodjax.discretization.shape import Shape
from rodjax.discretization.sliding_point import SlidingChange, SlidingLinearization, SlidingPoint
from rodjax.linalg.bordered import BorderedFactors, BorderedSystem, Vectors
from rodjax.linalg.chain import ChainSystem
from rodjax.linalg.saddle_point import AnySystem, factor_and_solve
from rodjax.linalg.unilateral_border import minimized_with_border
from rodjax.model.along import Along
from rodjax.model.scene import Scene, has_contacts
from rodjax.model.supports import Free, Support
from rodjax.programs.stacks import of_each

# The most of the way to the next support that a step takes a clip along the rod; and to the next load, which it may
# pass, as it then has a node of its own no more.
LARGEST_STEP = 0.3
NEAR_LOADS = 0.9
# The axial force that rounding of arclengths leaves where the rod is nearly taut, in units of EA.
PLACE_ROUNDINGS = 64
# A rod that is not yet in equilibrium in its clips, up to this residual [EI/L^2], comes to it first.
SETTLED = 0.1


class SlidingForm(MovingMeshForm):
    """A nondimensional scene as a function of a `SlidingPoint`. The multipliers begin with the arclengths.

    `descends`: whether steps go down from a largest energy by the arclengths, not to it.
    """

    descends: bool = eqx.field(static=True, default=False)

    @staticmethod
    def of(scene: Scene, shape: Shape) -> "SlidingForm":
        """The clips of the scene where they are to begin with."""
        return SlidingForm(scene=scene, made=scene, shape=shape, first=form_of(scene, shape))  # pyright: ignore

    def between(self, ends: tuple[Support, Support], pushed: Bool[Array, "2"]) -> "SlidingForm":
        """Of the rod between other supports of the same kinds; `pushed`: as of `PositionForm`."""

        def with_ends(scene: Scene) -> Scene:
            # Another one may bear a part of the load on its end.
            own = scene.start, scene.end
            both = tuple(end if isinstance(end, Free) else new for end, new in zip(own, ends, strict=True))
            return eqx.tree_at(lambda scene: (scene.start, scene.end), scene, both)

        first = eqx.tree_at(lambda form: form.scene, self.first, with_ends(self.first.scene))
        first = dataclasses.replace(first, pushed=pushed) if isinstance(first, NodalForm) else first
        return dataclasses.replace(self, scene=with_ends(self.scene), made=with_ends(self.made), first=first)

    # --- what is of the form at given arclengths ---------------------------------------------------------------------

    @property
    def layout(self) -> Any:  # pyright: ignore
        return self.first.layout

    @property
    def sliding_count(self) -> int:
        return len(self._numbers)

    @property
    def has_potential(self) -> bool:
        return dataclasses.replace(self.first, scene=self.scene).has_potential

    def bases_at(self, point: SlidingPoint) -> Float[Array, "3 b m"]:
        return self.first.bases_at(point.inner)

    def turn(self, point: SlidingPoint, bases: Float[Array, "3 b m"], axis: Float[Array, "3"]) -> Float[Array, "b m"]:
        return self.first.turn(point.inner, bases, axis)

    def spin(self, bases: Float[Array, "3 b m"]) -> Float[Array, "b m"] | None:
        return self.first.spin(bases)

    def holding(self, point: SlidingPoint) -> SlidingPoint:
        return dataclasses.replace(point, inner=self.at(point.arclengths).holding(point.inner))

    def settled(self, point: SlidingPoint) -> SlidingPoint:
        return dataclasses.replace(point, inner=self.at(point.arclengths).settled(point.inner))

    def in_plane(
        self, point: SlidingPoint, normal: Float[Array, "3"], axes: Float[Array, "3 2"]
    ) -> tuple["SlidingForm", SlidingPoint]:
        first, inner = self.first.in_plane(point.inner, normal, axes)
        return dataclasses.replace(self, first=first), dataclasses.replace(point, inner=inner)

    def in_plane_of(self, other: Form) -> "SlidingForm":
        return dataclasses.replace(self, first=self.first.in_plane_of(other))

    def out_of_plane(self, normal: Float[Array, "3"]) -> "SlidingForm":
        return dataclasses.replace(self, first=self.first.out_of_plane(normal))

    def edges(self, point: SlidingPoint) -> Float[Array, "segments 3"]:
        return self.at(point.arclengths).edges(point.inner)

    def elastic_energy(self, point: SlidingPoint) -> Float[Array, ""]:
        return self.at(point.arclengths).elastic_energy(point.inner)

    def load_energy(self, point: SlidingPoint) -> Float[Array, ""]:
        return self.at(point.arclengths).load_energy(point.inner)

    def tangents_in_clips(self, point: SlidingPoint) -> Float[Array, "3 clips"]:
        return self.at(point.arclengths).tangents_in_clips(point.inner)

    def multipliers_turned(
        self, point: SlidingPoint, axis: Float[Array, "3"], multipliers: Float[Array, "k"]
    ) -> Float[Array, "k"]:
        j = len(point.arclengths)
        of_inner = self.at(point.arclengths).multipliers_turned(point.inner, axis, multipliers[j:])
        return jnp.concatenate([multipliers[:j], of_inner])

    def is_closed(self, constraint_residual: Float[Array, "k"], tolerance: float) -> Bool[Array, ""]:
        return self.first.is_closed(constraint_residual[len(self._numbers) :], tolerance)

    def touches(self, point: SlidingPoint) -> Bool[Array, ""]:
        return self.first.touches(point.inner)

    @property
    def holds_loads(self) -> bool:
        return dataclasses.replace(self.first, scene=self.scene).holds_loads

    def held_loads(self, point: SlidingPoint) -> HeldLoads:
        return self.at(point.arclengths).held_loads(point.inner)

    def rounding_floor(self, point: SlidingPoint) -> Float[Array, ""]:
        return self.at(point.arclengths).rounding_floor(point.inner)

    # --- steps -------------------------------------------------------------------------------------------------------

    def others(self, multipliers: Float[Array, "k"]) -> SlidingChange:
        j = len(self._numbers)
        return SlidingChange(multipliers[:j], self.first.others(multipliers[j:]))

    def no_others(self, point: SlidingPoint) -> SlidingChange:
        return SlidingChange(jnp.zeros_like(point.arclengths), self.first.no_others(point.inner))

    def retract(
        self,
        point: SlidingPoint,
        bases: Float[Array, "3 b m"],
        rotation: Float[Array, "b m"],
        force_change: Float[Array, "3 parts"],
        others: Any = None,
    ) -> SlidingPoint:
        inner = self.at(point.arclengths).retract(point.inner, bases, rotation, force_change, others.others)
        return dataclasses.replace(point, inner=inner, arclengths=point.arclengths + others.arclengths)

    def longest_step(self, point: SlidingPoint, others: SlidingChange) -> Float[Array, ""]:
        change = self._spread(others.arclengths)
        ends = jnp.array([0.0, 1.0], change.dtype)
        clips = jnp.concatenate([ends[:1], self._clips + self._spread(point.arclengths - self.made_at), ends[1:]])
        gaps = LARGEST_STEP * jnp.minimum(jnp.diff(clips)[:-1], jnp.diff(clips)[1:])
        loads, beside = self._loads
        if len(loads):
            distances = (loads[None] - clips[1:-1, None]) * jnp.sign(change)[:, None]
            is_passed = (distances <= 0) | self._is_near(loads, self._clips[beside])[None]
            distances = jnp.where(is_passed, jnp.inf, NEAR_LOADS * distances)
            gaps = jnp.minimum(gaps, jnp.min(distances, axis=1))
        return jnp.min(gaps / jnp.maximum(jnp.abs(change), 1e-300))

    def accepts(self, point: SlidingPoint, trial: SlidingPoint, is_better: Bool[Array, ""]) -> Bool[Array, ""]:
        return self.at(point.arclengths).accepts(point.inner, trial.inner, is_better)

    def accepted(self, point: SlidingPoint, here: Any) -> SlidingPoint:
        inner = self.at(point.arclengths).accepted(point.inner, here.at_arclengths)
        return SlidingPoint(inner, point.arclengths, here.slides, here.excess)

    # --- derivatives -------------------------------------------------------------------------------------------------

    def _rows(self, inner: Any, arclengths: Float[Array, "j"]) -> tuple[Array, Array, Array, Array, Array | None]:
        """The gradient and the constraint residual at an inner point, L, -R . t, and the gaps of contacts."""
        form = self.at(arclengths)
        gradient, constraint_residual = form.residual_vectors(inner)
        force = form.layout.components(inner.end_force)
        energy = (
            form.elastic_energy(inner)
            + form.load_energy(inner)
            + jnp.sum(force * form.force_components(constraint_residual))
        )
        gaps = None
        if has_contacts(self.scene):
            assert isinstance(form, NodalForm)
            gaps = form.gaps(inner)
            energy -= jnp.sum(inner.nodal.pressures * gaps)
        return gradient, constraint_residual, energy, -form.axial_forces(inner), gaps

    def residual_vectors(self, point: SlidingPoint) -> tuple[Float[Array, "b m"], Float[Array, "k"]]:
        gradient, constraint_residual, _, axial, _ = self._rows(point.inner, point.arclengths)
        return gradient, jnp.concatenate([axial, constraint_residual])

    def linearized(self, point: SlidingPoint) -> SlidingLinearization:
        return self.with_arclengths(point, self.at(point.arclengths).linearized(point.inner))

    def with_arclengths(self, point: SlidingPoint, here: Linearization) -> SlidingLinearization:
        """From the linearisation of the form at fixed arclengths."""
        form, inner, arclengths = self.at(point.arclengths), point.inner, point.arclengths

        def by_arclength(direction: Float[Array, "j"]) -> tuple[Array, Array, Array, Array, Array | None]:
            return jax.jvp(lambda arclengths: self._rows(inner, arclengths), (arclengths,), (direction,))[1]

        gradient, constraint_residual, energy, corner, gap_rates = of_each(by_arclength)(
            jnp.eye(len(arclengths), dtype=arclengths.dtype)
        )

        def axial(rotation: Float[Array, "b m"], multipliers: Float[Array, "k"]) -> Float[Array, "j"]:
            force_change, others = form.layout.forces(form.force_components(multipliers)), form.others(multipliers)
            return -form.axial_forces(form.retract(inner, here.bases, rotation, force_change, others))

        nothing = jnp.zeros_like(here.gradient), jnp.zeros_like(here.constraint_residual)
        pulls, pulled = jax.vjp(axial, *nothing)
        rows = of_each(pulled)(jnp.eye(len(arclengths), dtype=arclengths.dtype))
        system = BorderedSystem(here.system, Vectors(gradient, constraint_residual), Vectors(*rows), corner.T)
        rounding = PLACE_ROUNDINGS * jnp.finfo(pulls.dtype).eps * _axial_stiffness(self.made)
        largest = jnp.max(jnp.abs(pulls))
        if gap_rates is not None:
            assert isinstance(here.system, ChainSystem)
            # Slips along obstacles are of the nodes, whose positions are unknowns of their own.
            slips = len(here.system.contacts.is_closed) - gap_rates.shape[1]
            gap_rates = jnp.pad(gap_rates, ((0, 0), (0, slips), (0, 0)))
        return SlidingLinearization(
            here.bases,
            here.gradient,
            jnp.concatenate([pulls, here.constraint_residual]),
            system,
            here.energy,
            jnp.where((largest > here.residual) & (largest > rounding), largest, here.residual),
            here.gaps,
            here.reference_displacements,
            arclengths=arclengths,
            slides=point.slides | (here.residual <= SETTLED),
            excess=energy - pulls,
            gap_rates=gap_rates,
        )

    def regular(self, system: AnySystem) -> AnySystem:
        return system.shifted(jnp.asarray(NEUTRAL / system.diagonal.shape[-1], system.diagonal.dtype))

    def shifted(self, system: Any, shift: Float[Array, ""]) -> Any:
        assert isinstance(system, BorderedSystem)
        return dataclasses.replace(system.shifted(shift), inner=self.first.shifted(system.inner, shift))

    def coupled(self, point: SlidingPoint, system: AnySystem) -> AnySystem:
        assert isinstance(system, BorderedSystem)
        return dataclasses.replace(system, inner=self.at(point.arclengths).coupled(point.inner, system.inner))

    def scaled(self, others: SlidingChange, motion: Any, multipliers: Any) -> SlidingChange:
        return SlidingChange(motion * others.arclengths, self.first.scaled(others.others, motion, multipliers))

    def objective(self, here: Any, point: SlidingPoint, others: SlidingChange) -> Float[Array, ""]:
        of_inner = self.at(here.arclengths).objective(here.at_arclengths, point.inner, others.others)
        return of_inner - point.excess_at(here.arclengths)

    def contact_energy(self, there: SlidingPoint, point: SlidingPoint, others: SlidingChange) -> Float[Array, ""]:
        form = self.at(there.arclengths)
        assert isinstance(form, NodalForm)
        return form.contact_energy(there.inner, point.inner, others.others)

    def lagrangian(self, point: SlidingPoint) -> tuple[Float[Array, ""], Float[Array, "c"]]:
        return self.at(point.arclengths).lagrangian(point.inner)

    def half_square(self, here: Any) -> Float[Array, ""]:
        axial = here.constraint_residual[: len(here.arclengths)]
        of_inner = self.at(here.arclengths).half_square(here.at_arclengths)
        return of_inner + jnp.where(here.slides, jnp.sum(axial**2) / 2, 0.0)

    def sought(
        self, here: Any, point: SlidingPoint, system: AnySystem, push: Float[Array, "b m"]
    ) -> tuple[Bool[Array, ""], Float[Array, "b m"], Float[Array, "k"]]:
        system, constraint_residual = self.sliding(here, system)
        j = len(point.arclengths)
        if here.gap_rates is not None:
            form = self.at(point.arclengths)
            assert isinstance(form, NodalForm)
            of_step = form.model_of_step(here.at_arclengths, point.inner, system.inner, push)
            rates = jnp.where(here.slides, here.gap_rates, 0.0)
            found = minimized_with_border(system, -constraint_residual[:j], rates, *of_step)
            return found.is_minimum, found.x, found.y
        factors, x, y = factor_and_solve(system, push - here.gradient, -constraint_residual, is_regularized=True)
        return self.has_minimum(factors, y), x, y

    def sliding(self, here: Any, system: AnySystem) -> tuple[BorderedSystem, Float[Array, "k"]]:
        """The system of a step and its constraint residual, at fixed arclengths unless the rod slides already."""
        assert isinstance(system, BorderedSystem)
        j = len(here.arclengths)
        axial = jnp.where(here.slides, here.constraint_residual[:j], 0.0)
        constraint_residual = jnp.concatenate([axial, here.constraint_residual[j:]])
        system = dataclasses.replace(system.held_unless(here.slides), descends=self.descends and self.has_potential)
        return system, constraint_residual

    def has_minimum(self, factors: Any, multipliers: Float[Array, "k"]) -> Bool[Array, ""]:
        """Whether a step leads to a minimum, from the factors of its system and its multipliers."""
        assert isinstance(factors, BorderedFactors)
        return factors.inner.is_minimum & factors.goes_down(multipliers[: len(factors.complement)])

    def under_force(
        self,
        point: SlidingPoint,
        here: Any,
        rotation: Float[Array, "b m"],
        change: Float[Array, "3 parts"],
        others: SlidingChange,
    ) -> tuple[Float[Array, "c"], Float[Array, "c"], Float[Array, ""], Float[Array, ""]]:
        form, columns = self.at(point.arclengths), here.system.columns
        found = form.under_force(point.inner, here.at_arclengths, rotation, change, others.others)
        constraint_residual, constraint_rate, more, along = found
        by_arclength = of_each(form.force_components)(columns.y)
        slope = here.constraint_residual[: len(point.arclengths)] + by_arclength @ form.layout.components(change)
        if here.gap_rates is not None:
            assert isinstance(form, NodalForm)
            # With the new pressures in place of the old ones, which -R . t has.
            rates = jnp.tensordot(others.arclengths, here.gap_rates, 1)
            along += form.contact_rate(here.at_arclengths, point.inner, others.others, rates)
            along += jnp.sum(point.inner.nodal.contact_forces * rates)
        return (
            constraint_residual,
            constraint_rate + others.arclengths @ by_arclength,
            more,
            along + jnp.sum(slope * others.arclengths),
        )


def at_its_arclengths(form: Form, point: Any) -> tuple[Form, Any]:
    """Of a rod that slides, form and point at the arclengths where its clips are."""
    return (form.at(point.arclengths), point.inner) if isinstance(form, SlidingForm) else (form, point)


def _axial_stiffness(scene: Scene) -> Float[Array, ""]:
    """The largest along the rod."""
    EA = scene.rod.stiffnesses[-1]
    return jnp.max(EA.samples) if isinstance(EA, Along) else EA
