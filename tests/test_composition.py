"""Every rod with every support, load, clip, obstacle and in its plane: which pairs solve, and which are refused why."""

import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rodjax as rj
from rodjax import (
    Clamp,
    Clip,
    DistributedCouple,
    DistributedForce,
    Free,
    Pin,
    PointForce,
    Potential,
    Rod,
    Scene,
    Steps,
    Swivel,
)
from rodjax.solving.options import checked_options

SEGMENTS = 8
X = (1.0, 0.0, 0.0)
START, END = (0.0, 0.0, 0.0), (0.8, 0.0, 0.0)
CLAMP, FAR = Clamp(START, rj.frame(X)), Clamp(END, rj.frame(X))
PLACE = (0.35, 0.0, 0.1)


class Stiffening(rj.Law):
    def __call__(self, curvature, twist, axial_strain, s):
        bending = curvature[0] ** 2 / 2 + curvature[1] ** 2 / 2 + 0.01 * curvature[1] ** 4
        return bending + 0.35 * twist**2 + 5e3 * axial_strain**2


def bedding(position, s):
    return 10.0 * position[2] ** 2


def rod(EI=1.0, **more) -> Rod:
    return Rod(1.0, EI, 0.7, 1e4, mass_per_length=0.1, radius=0.01, **more)


# What a feature makes of a scene whose other features are the first of their kind. Rods are made when they are asked
# for: to make some takes programs, and tests are collected by several processes at once.
FEATURES = {
    "rod": {
        "plain": lambda: rod(),
        "flat": lambda: rod((1.0, 2.0)),
        "curved": lambda: rod(rest_curvature=(0.0, 1.0)),
        "twisted": lambda: rod((1.0, 2.0), rest_twist=1.0),
        "varying": lambda: rod(rj.Smooth([0.0, 0.5, 1.0], [1.0, 1.5, 2.0])),
        "stepped": lambda: rod(Steps([0.5], [1.0, 2.0])),
        "law": lambda: rod(law=Stiffening()),
        "shearing": lambda: rod(GA=(200.0, 300.0)),
        "heated": lambda: rod(rest_strain=Steps([0.5], [0.0, 0.01])),
    },
    "ends": {
        "clamps": (CLAMP, FAR),
        "clamp and swivel": (CLAMP, Swivel(END, X)),
        "pins": (Pin(START), Pin(END)),
        "clamp and free": (CLAMP, Free()),
        "free and clamp": (Free(), FAR),
    },
    "load": {
        "gravity": {},
        "point force": {"point_forces": [PointForce(0.6, (0.0, 0.0, 2.0))]},
        "uniform force": {"distributed": [DistributedForce((0.0, 0.0, 2.0))]},
        "follower force along": {"distributed": [DistributedForce((0.5, 0.0, 0.0), follower=True)]},
        "field": {"potentials": [Potential(bedding)]},
        "couple along": {"distributed": [DistributedCouple((0.0, 0.5, 0.0))]},
        "force on a part": {"distributed": [DistributedForce((0.0, 0.0, 4.0), part=(0.3, 0.6))]},
        "point couple": {"point_couples": [rj.PointCouple(0.55, (0.0, 0.5, 0.0))]},
        "follower point force": {"point_forces": [PointForce(0.55, (0.5, 0.0, 0.0), follower=True)]},
        "end force": {"end": {"force": (0.0, 0.0, 2.0)}},
        "end moment": {"end": {"moment": (0.0, 1.0, 0.0)}},
        "follower end force": {"end": {"force": (0.0, 0.0, 1.0), "follower": True}},
    },
    "clip": {
        "none": (),
        "position": (Clip(0.4, PLACE),),
        "tangent": (Clip(0.4, PLACE, tangent=(1.0, 0.0, 0.2)),),
        "frame": (Clip(0.4, PLACE, frame=rj.frame((1.0, 0.0, 0.2))),),
        "sliding": (Clip(0.4, PLACE, sliding=True),),
        "sliding tangent": (Clip(0.4, PLACE, tangent=(1.0, 0.0, 0.2), sliding=True),),
        "sliding frame": (Clip(0.4, PLACE, frame=rj.frame((1.0, 0.0, 0.2)), sliding=True),),
    },
    "obstacle": {"none": (), "floor": (rj.Plane((0.0, 0.0, -0.1), (0.0, 0.0, 1.0)),)},
    "planar": {"no": False, "yes": True},
}
FIRST = {kind: next(iter(names)) for kind, names in FEATURES.items()}
# What is refused for a reason of physics.
PHYSICS = {
    "planar must be False for a moment on a free end": "it twists the rod as it leaves the plane, and has no potential",
    "planar must be False for a rod that is twisted at rest": "bending turns it out of the plane",
}


def scene_of(names: dict[str, str]) -> Scene | None:
    """`None` where a load on the end goes with an end that is not free."""
    of = {kind: FEATURES[kind][name] for kind, name in (FIRST | names).items()}
    start, end = of["ends"]
    load = dict(of["load"])
    on_end = load.pop("end", None)
    if on_end is not None:
        if "ends" in names and not isinstance(end, Free):
            return None
        start, end = (CLAMP if "ends" not in names else start), Free(**on_end)
    return Scene(of["rod"](), start, end, (0.0, 0.0, -9.81), clips=of["clip"], obstacles=of["obstacle"], **load)


def pairs() -> list[dict[str, str]]:
    found = []
    for kind, other in itertools.combinations(FEATURES, 2):
        names = itertools.product(list(FEATURES[kind])[1:], list(FEATURES[other])[1:])
        found += [{kind: name, other: other_name} for name, other_name in names]
    return found


def refused(names: dict[str, str]) -> str | None:
    """What is said of a scene that is refused."""
    try:
        scene = scene_of(names)
        if scene is not None:
            checked_options(scene, SEGMENTS, planar=FEATURES["planar"][names.get("planar", "no")])
    except ValueError as error:
        return str(error)
    return None


def test_what_is_refused_is_listed():
    """Of all pairs of features."""
    messages = [message for message in map(refused, pairs()) if message is not None]
    for message in messages:
        assert any(reason in message for reason in PHYSICS), message
    for reason in PHYSICS:
        assert any(reason in message for message in messages), reason
    assert (len(pairs()), len(messages)) == (361, 2)


def solved(names: dict[str, str]) -> rj.Equilibrium:
    scene = scene_of(names)
    assert scene is not None
    result = rj.solve(scene, segments=SEGMENTS, planar=FEATURES["planar"][names.get("planar", "no")])
    assert result.converged, rj.describe(result)
    if any(kind in names.get("load", "") for kind in ("follower", "field")):
        return result
    loads = scene.rod.mass_per_length * scene.gravity
    loads += sum((load.force for load in scene.point_forces), jnp.zeros(3))
    for load in scene.distributed:
        if isinstance(load, DistributedForce):
            loads += load.force * (1.0 if load.part is None else load.part[1] - load.part[0])
    supports = jnp.sum(result.clip_forces, axis=0) + jnp.sum(result.contact_forces, axis=0)
    supports += result.end_force - result.start_force
    # The residual of 1e-8 EI/L^2, of forces of about 100.
    np.testing.assert_allclose(supports, -loads, rtol=0, atol=1e-6)
    return result


# What the rods of harnesses do not have, in one line: a plain rod, by tangents, does not tell what a dead moment on its
# end does where its other end turns; on a joint it is known.
NOT_IN_HARNESSES = {"make that end a Joint of a Harness, and give its Body the moment": ["end moment"]}


def harness_of(names: dict[str, str]) -> rj.Harness:
    """A rod with these features, joined to a plain one that goes on from one of its ends."""
    scene = scene_of(names)
    assert scene is not None
    joint = rj.Joint("j", rj.frame(X))
    on = Scene(rod(), joint, Clamp((1.6, 0.0, 0.0), rj.frame(X)), scene.gravity)
    if isinstance(scene.end, Free) and not isinstance(scene.start, Free):
        on = Scene(rod(), Clamp((-0.8, 0.0, 0.0), rj.frame(X)), joint, scene.gravity)
        return rj.Harness({"rod": eqx.tree_at(lambda scene: scene.start, scene, joint), "on": on})
    return rj.Harness({"rod": eqx.tree_at(lambda scene: scene.end, scene, joint), "on": on})


OF_HARNESSES = [
    {kind: name} for kind, names in FEATURES.items() if kind not in ("planar", "ends") for name in list(names)[1:]
] + [{"ends": name} for name in FEATURES["ends"]]
# What slides has columns of its own beside contacts, fields and loads that follow the rod.
SLIDING_IN_HARNESSES = [
    {"clip": clip, kind: name}
    for clip in FEATURES["clip"]
    if "sliding" in clip
    for kind in ("load", "obstacle")
    for name in list(FEATURES[kind])[1:]
]


def test_what_harnesses_refuse_is_listed():
    found = {}
    for names in OF_HARNESSES:
        try:
            harness_of(names)
        except ValueError as error:
            found[next(iter(names.values()))] = str(error)
    expected = {name: message for message, names in NOT_IN_HARNESSES.items() for name in names}
    assert found.keys() == expected.keys()
    for name, message in expected.items():
        assert message in found[name]
        assert "\n" not in found[name]


@pytest.mark.slow
@pytest.mark.exhaustive
@pytest.mark.parametrize("names", OF_HARNESSES + SLIDING_IN_HARNESSES, ids=lambda names: ", ".join(names.values()))
def test_every_feature_solves_in_a_harness(names):
    if any(name in refused for refused in NOT_IN_HARNESSES.values() for name in names.values()):
        pytest.skip("refused")
    result = rj.solve(harness_of(names), segments=SEGMENTS)
    assert result.converged, rj.describe(result)
    at_joint = [
        (rod.end_force, 1.0) if np.allclose(rod.nodes[-1], result.joints["j"].position) else (rod.start_force, -1.0)
        for rod in result.values()
    ]
    force = sum(-sign * force for force, sign in at_joint) + result.joints["j"].contact_force
    # The residual of 1e-8 EI/L^2, of forces of about 100.
    np.testing.assert_allclose(force, 0.0, rtol=0, atol=1e-6)


# What branches (`rj.follow`, `rj.critical_point`, `at_critical="stop"`) refuse: loads without a potential, as no energy
# tells where they lose stability.
NOT_ON_BRANCHES = {
    "have none": [
        "follower force along",
        "couple along",
        "point couple",
        "follower point force",
        "end moment",
        "follower end force",
    ],
}


def test_what_branches_refuse_is_listed():
    found = {}
    for kind, names in FEATURES.items():
        for name in list(names)[1:] if kind != "planar" else []:
            scene = scene_of({kind: name})
            for operation in (rj.follow, rj.critical_point):
                try:
                    # What begins far beyond the scenes is refused after all else.
                    operation([scene, scene], start=9.0)
                except ValueError as error:
                    if "start must lie" not in str(error):
                        found[name] = str(error)
    expected = {name: message for message, names in NOT_ON_BRANCHES.items() for name in names}
    assert found.keys() == expected.keys()
    for name, message in expected.items():
        assert message in found[name]


# Each feature that solves at least once, several at a time.
TOGETHER = [
    {"rod": "varying", "ends": "clamp and swivel", "load": "point force", "clip": "tangent"},
    {"rod": "law", "ends": "clamp and free", "load": "end moment", "clip": "frame"},
    {"ends": "pins", "clip": "position", "obstacle": "floor"},
    {"rod": "flat", "ends": "free and clamp", "clip": "sliding"},
    {"rod": "curved", "clip": "frame", "obstacle": "floor"},
    {"load": "follower force along", "clip": "sliding frame", "obstacle": "floor"},
    {"ends": "pins", "clip": "sliding tangent"},
    {"rod": "curved", "load": "field", "clip": "sliding", "obstacle": "floor"},
    {"ends": "clamp and free", "load": "end moment", "obstacle": "floor"},
    {"rod": "shearing", "ends": "clamp and swivel", "load": "point couple", "clip": "sliding", "obstacle": "floor"},
    {"rod": "heated", "load": "force on a part", "clip": "tangent"},
]


@pytest.mark.parametrize("names", TOGETHER, ids=lambda names: ", ".join(names.values()))
def test_features_compose(names):
    solved(names)


# Sections that spin between pins without a change of the energy to second order, or under a load that goes with them:
# no derivative is a number there.
CRITICAL = [{"rod": "law", "ends": "pins"}, {"ends": "pins", "load": "follower force along"}]


@pytest.mark.slow
@pytest.mark.exhaustive
@pytest.mark.parametrize("names", pairs(), ids=lambda names: ", ".join(names.values()))
def test_every_pair_solves_and_has_derivatives(names):
    if refused(names) is not None or scene_of(names) is None:
        pytest.skip("refused, or no scene")
    solved(names)

    def tip(scale):
        scene = scene_of(names)
        scaled = eqx.tree_at(lambda scene: scene.gravity, scene, scale * scene.gravity)
        result = rj.solve(scaled, segments=SEGMENTS, planar=FEATURES["planar"][names.get("planar", "no")])
        return jnp.sum(result.nodes**2)

    assert np.isfinite(jax.jvp(tip, (jnp.array(1.0),), (jnp.array(1.0),))[1]) == (names not in CRITICAL)
