"""Steps that must not lead a rod through an obstacle.

A step keeps each node on its side of the tangent plane of an obstacle, which of a convex one separates. One that is not
convex, or thinner than nodes are apart, no tangent plane keeps out: so nodes and points between them are followed on
their straight lines through the step (`stays_outside`). Not of half spaces, which have no other side: however deep a
step leads into one between nodes, the next leads out.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from rodjax.discretization.node_positions import PositionForm
from rodjax.geometry.interpolation import cubic
from rodjax.model.obstacles import has_other_side, least

# A step takes no point deeper than this, in parts of the radius, into an obstacle; one that is there already so much
# deeper. Into one that is less thick than the rod none nearer than a part of the radius, else short steps would lead
# through in turn. Looked at are the nodes and these parts of elements, at most so often on their line, each time
# further by the distance, or by so much at least.
DEEPEST = 0.5
DEEPER = 0.125
NEAREST = 0.25
THIN = 0.5
LOOKED_AT = tuple(k / 8 for k in range(1, 8))
LEAST_ADVANCE = 0.05
MOST_LOOKS = 24


def stays_outside(form: PositionForm, point: Any, trial: Any, is_better: Bool[Array, ""]) -> Bool[Array, ""]:
    """Whether a step that is better also leads nodes, and points between them, nowhere too deep into an obstacle."""
    obstacles = [obstacle for obstacle in form.scene.obstacles if has_other_side(obstacle)]
    if not obstacles:
        return is_better
    before, after = _looked_at(form, point), _looked_at(form, trial)
    displacements = after - before
    distance = jnp.sqrt(jnp.sum(displacements**2, axis=1))
    radius = form.radius
    rim = jnp.concatenate([radius, *[least(radius[:-1], radius[1:])] * len(LOOKED_AT)])

    def distances(positions: Float[Array, "k 3"]) -> Float[Array, "k"]:
        return least(*(jax.vmap(obstacle.at)(positions) for obstacle in obstacles))

    first = distances(before)
    bound = least(DEEPEST * rim, first - DEEPER * rim)

    def pierces() -> Bool[Array, ""]:
        """Whether a point ends too near to something thin."""
        is_near = (distances(after) < NEAREST * rim) & (first >= NEAREST * rim)

        def is_thin(position: Float[Array, "3"], rim: Float[Array, ""]) -> Bool[Array, ""]:
            def nearest(position: Float[Array, "3"]) -> Float[Array, ""]:
                return least(*(obstacle.at(position) for obstacle in obstacles))

            depth, normal = jax.value_and_grad(nearest)(position)
            return nearest(position - (depth + rim) * normal) > -THIN * rim

        return jax.lax.cond(
            jnp.any(is_near), lambda: jnp.any(is_near & jax.vmap(is_thin)(after, rim)), lambda: jnp.array(False)
        )

    # No point is nearer than its distance: so far each may advance before it is looked at again.
    def ahead(gone: Float[Array, "k"], gaps: Float[Array, "k"]) -> Float[Array, "k"]:
        return gone + jnp.maximum(gaps, LEAST_ADVANCE * rim)

    def looked(state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        gone, _, count = state
        parts = jnp.minimum(gone / jnp.where(distance > 0, distance, 1.0), 1.0)
        gaps = distances(before + parts[:, None] * displacements) - bound
        return ahead(gone, gaps), jnp.any(gaps < 0), count + 1

    def goes_on(state: tuple[Array, Array, Array]) -> Bool[Array, ""]:
        gone, is_blocked, count = state
        return is_better & jnp.any(gone < distance) & ~is_blocked & (count < MOST_LOOKS)

    begin = ahead(jnp.zeros_like(distance), first - bound), pierces(), jnp.zeros((), int)
    gone, is_blocked, _ = jax.lax.while_loop(goes_on, looked, begin)
    return is_better & ~is_blocked & jnp.all(gone >= distance)


def _looked_at(form: PositionForm, point: Any) -> Float[Array, "k 3"]:
    nodes, slopes = point.nodal.positions, point.tangents[:, ::2].T
    s = form.field.s
    between = s[None, :-1] + jnp.asarray(LOOKED_AT, s.dtype)[:, None] * jnp.diff(s)[None]
    return jnp.concatenate([nodes, cubic(s, nodes, slopes, between.reshape(-1))])
