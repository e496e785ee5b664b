"""How long a string is that is pulled taut around obstacles: what a rod needs at least to pass them on its side."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from rodjax.model.obstacles import Obstacle, least
from rodjax.programs.compilation import compiled

# Pieces of the string, at its chords: too short by their angle squared over 24, so that too little is asked for. Each
# place goes so often to the middle of its neighbours, and then out of the obstacles.
PIECES = 32
ROUNDS = 1500
# The string touches an obstacle from which it is less than this part of the radius away.
TOUCHES = 0.05


@compiled
def taut(
    points: Float[Array, "p 3"], obstacles: tuple[Obstacle, ...], radius: Float[Array, ""]
) -> tuple[Float[Array, ""], Bool[Array, "k"]]:
    """The length of a string that begins as `points` and is pulled taut between its ends, nowhere nearer to an obstacle
    than `radius`, and which obstacles it touches. It stays on its side of what is thicker than its steps.
    """
    steps = (len(points) - 1) // PIECES
    string = points[::steps]

    def nearest(point: Float[Array, "3"]) -> Float[Array, ""]:
        return least(*(obstacle.at(point) for obstacle in obstacles))

    def pulled(_, string: Float[Array, "q 3"]) -> Float[Array, "q 3"]:
        inner = (string[:-2] + string[2:]) / 2
        distances, normals = jax.vmap(jax.value_and_grad(nearest))(inner)
        out = jnp.where(distances < radius, radius - distances, 0.0)
        return string.at[1:-1].set(inner + out[:, None] * normals)

    string = jax.lax.fori_loop(0, ROUNDS, pulled, string)
    touched = jnp.stack(
        [jnp.min(jax.vmap(obstacle.at)(string[1:-1])) < (1 + TOUCHES) * radius for obstacle in obstacles]
    )
    return jnp.sum(jnp.sqrt(jnp.sum(jnp.diff(string, axis=0) ** 2, axis=1))), touched
