"""The mesh of a rod that slides through clips: its nodes go along with them, until it is made anew."""

import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from rodjax.discretization.edges import EdgeTangents
from rodjax.discretization.finite_difference import Polyline
from rodjax.discretization.form import Form
from rodjax.discretization.forms import form_of, form_on
from rodjax.discretization.node_positions import PositionForm
from rodjax.discretization.nodes import LEAST_ELEMENT, varying
from rodjax.discretization.shape import Shape
from rodjax.discretization.sliding_point import SlidingPoint
from rodjax.model.scene import Scene, slid, sliding_arclengths

# Elements beside a clip that have become longer or shorter by this factor are made anew.
STRETCHED = 1.25
# A rod has slid out of a clip that is nearer to an end, or to the next clip [L]; and where no equilibrium is found, is
# about to with one that is so near.
SLID_OUT = 1e-4
NEARLY_OUT = 1e-2
# Nodes that lie apart by less [L] are the same.
SAME_NODE = 1e-9


class MovingMeshForm(Form):
    """A form at the arclengths of sliding clips, on a mesh whose nodes at the clips go along with them.

    `made`: the scene of which forms are made, on meshes that are the one of `shape` where the clips are as in `made`;
    `scene`: with other loads, of which a search may have a part. `first`: the form there, in its plane if it has one.
    """

    scene: Scene
    made: Scene
    shape: Shape
    first: Form

    @property
    def field(self) -> Any:
        return self.first.field

    def at(self, arclengths: Float[Array, "j"]) -> Form:
        """The form at these arclengths."""
        scene, field = slid(self.made, arclengths), self.field
        s = field.s + jnp.interp(field.s, *self._fixed(arclengths))
        s = s.at[field.clip_nodes].set(jnp.stack([clip.at for clip in scene.clips]))
        if isinstance(field, EdgeTangents):
            field = EdgeTangents(jnp.diff(s), s, field.clip_nodes)
        else:
            field = dataclasses.replace(field, s=s)
        form = form_on(scene, field).in_plane_of(self.first)
        form = dataclasses.replace(form, scene=slid(self.scene, arclengths))
        if not isinstance(form, PositionForm):
            return form
        assert isinstance(self.first, PositionForm)
        return dataclasses.replace(form, closed=self.first.closed, pushed=self.first.pushed)

    def _fixed(self, arclengths: Float[Array, "j"]) -> tuple[Float[Array, "k"], Float[Array, "k"]]:
        """Arclengths that have nodes, in turn, and how far those go along."""
        at, change = self._clips, self._spread(arclengths - self.made_at)
        ends = jnp.array([0.0, 1.0], at.dtype)
        loads, beside = self._loads
        # A load so near to a clip that it shares its node goes along.
        near = self._is_near(loads, at[beside])
        of_loads = jnp.where(near, change[beside], 0.0)
        fixed = jnp.concatenate([ends, at, jnp.where(near, at[beside], loads)])
        order = jnp.argsort(fixed)
        return fixed[order], jnp.concatenate([jnp.zeros_like(ends), change, of_loads])[order]

    @property
    def _clips(self) -> Float[Array, "clips"]:
        return jnp.stack([clip.at for clip in self.made.clips])

    @property
    def made_at(self) -> Float[Array, "j"]:
        """The arclengths to which the mesh of the shape belongs."""
        arclengths = sliding_arclengths(self.made)
        assert arclengths is not None
        return arclengths

    def _spread(self, of_sliding: Float[Array, "j"]) -> Float[Array, "clips"]:
        """Zero for clips that do not slide."""
        return jnp.zeros(len(self.made.clips), of_sliding.dtype).at[self._numbers].set(of_sliding)

    @property
    def _numbers(self) -> np.ndarray:
        return np.array([k for k, clip in enumerate(self.made.clips) if clip.sliding])

    @property
    def _loads(self) -> tuple[Float[Array, "k"], Int[Array, "k"]]:
        """Other arclengths with nodes, and the nearest clip to each."""
        arclengths = [] if isinstance(self.shape, Polyline) else [load.at for load in self.made.point_forces]
        arclengths = [jnp.atleast_1d(place) for place in (*arclengths, *varying(self.made))]
        loads = jnp.concatenate([jnp.zeros(0, self._clips.dtype), *arclengths])
        return loads, jnp.argmin(jnp.abs(loads[:, None] - self._clips[None]), axis=1)

    def _is_near(self, loads: Float[Array, "k"], clips: Float[Array, "k"]) -> Bool[Array, "k"]:
        return jnp.abs(loads - clips) * (len(self.first.field.s) - 1) < LEAST_ELEMENT

    # --- where the mesh is made anew ---------------------------------------------------------------------------------

    def is_blocked(self, point: SlidingPoint) -> Bool[Array, ""] | None:
        """Whether a clip has come to a load, beyond which the mesh is another one."""
        loads, beside = self._loads
        if not len(loads):
            return None
        now = self._clips + self._spread(point.arclengths - self.made_at)
        return jnp.any(self._is_near(loads, now[beside]) & ~self._is_near(loads, self._clips[beside]))

    def has_slid_out(self, point: SlidingPoint, is_given_up: Bool[Array, ""]) -> Bool[Array, ""]:
        """Or two clips have come together along it."""
        ends = jnp.array([0.0, 1.0], point.arclengths.dtype)
        now = self._clips + self._spread(point.arclengths - self.made_at)
        lengths = jnp.diff(jnp.concatenate([ends[:1], now, ends[1:]]))
        # Clips that hold the rod may be as near to one another as they like.
        beside = np.union1d(self._numbers, self._numbers + 1)
        return jnp.any(lengths[beside] < jnp.where(is_given_up, NEARLY_OUT, SLID_OUT))

    def is_misplaced(self, point: SlidingPoint) -> Bool[Array, ""]:
        """Whether the mesh is not, or should not be, the one that belongs to these arclengths."""
        form = self.at(point.arclengths)
        ends = jnp.array([0.0, 1.0], point.arclengths.dtype)
        now = self._clips + self._spread(point.arclengths - self.made_at)
        before, after = (jnp.diff(jnp.concatenate([ends[:1], at, ends[1:]])) for at in (self._clips, now))
        is_stretched = jnp.any(jnp.maximum(before / after, after / before) > STRETCHED)
        anew = form_of(slid(self.made, point.arclengths), self.shape.reached(form, point.inner))
        return is_stretched | jnp.any(jnp.abs(anew.field.s - form.field.s) > SAME_NODE)
