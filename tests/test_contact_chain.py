"""Contact forces, gaps and places beside obstacles of every kind, by an independent solution: a chain of links."""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import minimize, nnls

import rodjax as rj

LENGTH, RADIUS, WEIGHT, FLOOR = 4.6, 0.03, 150.0, -0.15
BEGIN = np.array([0.0, 0.08])
CLAMP = rj.Clamp((0.0, 0.0, 0.08), rj.frame((1.0, 0.0, 0.0)))


def prism(outline: np.ndarray) -> rj.Mesh:
    """A body between y = -0.2 and 0.2, of a convex outline in x and z."""
    count = len(outline)
    sides = [np.insert(outline, 1, y, axis=1) for y in (-0.2, 0.2)]
    fan = [(0, k, k + 1) for k in range(1, count - 1)]
    around = [(k, (k + 1) % count) for k in range(count)]
    faces = [*fan, *[(count + a, count + c, count + b) for a, b, c in fan]]
    faces += [(a, count + a, b) for a, b in around] + [(b, count + a, count + b) for a, b in around]
    return rj.Mesh(np.concatenate(sides), faces)


def roof(x: float, z: float) -> np.ndarray:
    """With a ridge along y."""
    return np.array([[x, z], [x - 0.06, z - 0.1], [x + 0.06, z - 0.1]])


# Kind, x, height of the top, the obstacle; in the plane of the rod a disc, a rectangle or a roof.
ROUND, DEEP = 0.05, 0.1
Y = np.array([0.0, 1.0, 0.0])
PLACED: list[tuple[str, float, float]] = [
    ("disc", 0.5, 0.03),
    ("disc", 1.0, 0.02),
    ("rectangle", 1.5, 0.03),
    ("roof", 2.0, 0.01),
    ("disc", 2.5, 0.02),
    ("rectangle", 3.0, 0.0),
    ("disc", 3.5, -0.01),
]


def obstacles() -> list[rj.Obstacle]:
    """In the order of `PLACED`, and a floor."""
    centers = [np.array([x, 0.0, z - (ROUND if kind == "disc" else DEEP / 2)]) for kind, x, z in PLACED]
    size = np.array([0.08, 0.4, DEEP])
    far = rj.Sphere((0.0, 0.0, -5.0), 0.1)
    own = jnp.asarray(centers[6])
    return [
        rj.Sphere(centers[0], ROUND),
        rj.Capsule(centers[1] - 0.2 * Y, centers[1] + 0.2 * Y, ROUND),
        rj.Box(centers[2], size),
        prism(roof(*PLACED[3][1:])),
        rj.Cylinder(centers[4] - 0.2 * Y, centers[4] + 0.2 * Y, ROUND),
        rj.Union(rj.Box(centers[5], size), far),
        rj.Distance(lambda point: jnp.sqrt((point[0] - own[0]) ** 2 + (point[2] - own[2]) ** 2) - ROUND),
        rj.Plane((0.0, 0.0, FLOOR), (0.0, 0.0, 1.0)),
    ]


def to_polygon(points: np.ndarray, corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distances of points outside from a convex outline, and their gradients."""
    start, edge = corners, np.roll(corners, -1, axis=0) - corners
    share = np.einsum("pkc,kc->pk", points[:, None] - start, edge) / np.sum(edge**2, axis=1)
    nearest = start + np.clip(share, 0, 1)[..., None] * edge
    offsets = points[:, None] - nearest
    squared = np.sum(offsets**2, axis=-1)
    best = np.argmin(squared, axis=1)
    distance = np.sqrt(squared[np.arange(len(points)), best])
    return distance, offsets[np.arange(len(points)), best] / distance[:, None]


def distances(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of points (p, 2) from all obstacles (k, p), and the gradients (k, p, 2), written anew."""
    found = []
    for kind, x, z in PLACED:
        if kind == "disc":
            offset = points - [x, z - ROUND]
            size = np.linalg.norm(offset, axis=1)
            found.append((size - ROUND, offset / size[:, None]))
            continue
        corners = roof(x, z)
        if kind == "rectangle":
            corners = np.array([[x - 0.04, z - DEEP], [x + 0.04, z - DEEP], [x + 0.04, z], [x - 0.04, z]])
        found.append(to_polygon(points, corners))
    found.append((points[:, 1] - FLOOR, np.tile([0.0, 1.0], (len(points), 1))))
    return np.stack([each[0] for each in found]), np.stack([each[1] for each in found])


# A chain is looked at, and weighs, at so many places of each link.
PARTS = 4


class Chain(NamedTuple):
    """Of links in equilibrium: places on them (p, 2), the pressures of the obstacles there (k, p), and the moments that
    are out of balance.
    """

    places: np.ndarray
    pressures: np.ndarray
    left: float


def chain(first: np.ndarray, EI: float, rest_curvature: float) -> Chain:
    """A chain of rigid links with springs in its joints, near the first angles."""
    n = len(first)
    link = LENGTH / n
    # The length of each link before each place.
    lengths = link * np.clip(np.arange(1, PARTS * n + 1)[:, None] / PARTS - np.arange(n), 0, 1)
    loads = np.full(PARTS * n, WEIGHT * link / PARTS)
    loads[-1] /= 2
    springs = np.full(n, EI / link)
    springs[0] *= 2  # half a link from the clamp to the middle of the first one
    rest = rest_curvature * EI / springs

    def places(angles: np.ndarray) -> np.ndarray:
        return BEGIN + lengths @ np.stack([np.cos(angles), np.sin(angles)], axis=1)

    def rates(angles: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Of the places along directions, by the angles (p, n)."""
        return lengths * (directions @ np.stack([-np.sin(angles), np.cos(angles)]))

    def energy(angles: np.ndarray) -> tuple[float, np.ndarray]:
        bends = np.diff(angles, prepend=0.0) - rest
        moments = springs * bends
        gradient = loads @ rates(angles, np.tile([0.0, 1.0], (PARTS * n, 1))) + moments
        gradient[:-1] -= moments[1:]
        return moments @ bends / 2 + loads @ places(angles)[:, 1], gradient

    def gaps(angles: np.ndarray) -> np.ndarray:
        return np.min(distances(places(angles))[0], axis=0) - RADIUS

    def rates_of_gaps(angles: np.ndarray) -> np.ndarray:
        found, directions = distances(places(angles))
        return rates(angles, directions[np.argmin(found, axis=0), np.arange(PARTS * n)])

    apart: Any = {"type": "ineq", "fun": gaps, "jac": rates_of_gaps}
    angles = minimize(energy, first, jac=True, method="SLSQP", constraints=apart, options={"maxiter": 500}).x
    # The pressures that hold it in balance where it touches.
    there = places(angles)
    far, directions = distances(there)
    row, place = np.nonzero(far - RADIUS < 1e-6)
    by_angles = [rates(angles, directions[k])[j] for k, j in zip(row, place, strict=True)]
    pressures = np.zeros(far.shape)
    pressures[row, place], left = nnls(np.stack(by_angles, axis=1), energy(angles)[1])
    return Chain(there, pressures, left)


# Numbers of the rod, and its curvature at rest in the plane, upwards.
RODS = {
    "plain": ({"EI": 1.0}, 0.0),
    "flat and curved": ({"EI": (5.0, 1.0), "rest_curvature": (0.0, -3.0)}, 3.0),
}


@pytest.fixture(scope="module")
def plain() -> rj.Equilibrium:
    return lying("plain", None)


def lying(name: str, guess: rj.Equilibrium | None) -> rj.Equilibrium:
    rod = rj.Rod(LENGTH, GJ=0.8, EA=1e6, mass_per_length=WEIGHT / 10, radius=RADIUS, **RODS[name][0])
    scene = rj.Scene(rod, CLAMP, rj.Free(), (0, 0, -10.0), obstacles=obstacles())
    shape = None if guess is None else rj.Guess(guess.nodes)
    return rj.solve(scene, segments=96, planar=True, guess=shape, strain_limit=None)


@pytest.mark.parametrize("name", ["plain", pytest.param("flat and curved", marks=pytest.mark.exhaustive)])
def test_a_chain_of_links_has_the_same_forces_places_and_gaps(name, plain):
    result = plain if name == "plain" else lying(name, plain)
    assert result.converged
    links = 160
    middles, tangents = (np.arange(links) + 0.5) * LENGTH / links, np.asarray(result.tangents)
    first = np.interp(middles, result.s, np.arctan2(tangents[:, 2], tangents[:, 0]))
    found = chain(first, 1.0, RODS[name][1])
    assert found.left < 1e-4 * WEIGHT * LENGTH**2
    _, directions = distances(found.places)
    of_chain = np.einsum("kj,kjc->kc", found.pressures, directions)
    of_rod = np.asarray(result.obstacle_forces)[..., ::2]
    assert np.all(of_rod.sum(1)[:, 1] > 50.0)
    # A chain touches between places a quarter of a link apart, 7 mm; forces follow by as much of a span.
    np.testing.assert_allclose(of_rod.sum(1)[:, 1], of_chain[:, 1], rtol=0.015)
    where = np.sum(of_rod[..., 1] * np.asarray(result.nodes)[:, 0], axis=1) / of_rod[..., 1].sum(1)
    of_chain_where = found.pressures @ found.places[:, 0] / found.pressures.sum(1)
    np.testing.assert_allclose(where, of_chain_where, rtol=0, atol=0.01)
    np.testing.assert_allclose(result.nodes[-1, ::2], found.places[-1], rtol=0, atol=1e-3)
    # Gaps between the nodes too, by the distances of the chain; coarse elements lie so much nearer at their middles.
    along = np.asarray(result.position_at(np.linspace(0.0, LENGTH, 2001)))[:, ::2]
    far, _ = distances(along[1:])
    np.testing.assert_allclose(far.min(axis=1), RADIUS, rtol=2e-3)
