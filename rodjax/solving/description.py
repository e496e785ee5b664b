"""What `describe` says of an equilibrium: how its solve ended, and what is special about it."""

from abc import abstractmethod

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Bool, Int

from rodjax.checks import instance, leaf
from rodjax.discretization.moving_mesh import NEARLY_OUT
from rodjax.discretization.node_contacts import SLIPS, STICKS
from rodjax.mechanics.passage import Passage
from rodjax.mechanics.taut import taut
from rodjax.model.rod import Rod
from rodjax.model.scene import has_potential
from rodjax.model.summaries import obstacle_name
from rodjax.model.supports import Held
from rodjax.solving import applied_forces
from rodjax.solving.penetration import MOST_PENETRATION, passage_of, penetration
from rodjax.solving.result import Equilibrium, Examination, examination_of
from rodjax.solving.result_errors import estimated_errors, moment_error_of
from rodjax.solving.status import Status

# Of several rods that came through obstacles, so many are named.
MOST_NAMED = 3
# A rod is called too short where it lacks this part of its length.
LEAST_LACKING = 1e-3


class Described(eqx.Module):
    """A result that `describe` lets say in words what it is."""

    @abstractmethod
    def in_words(self) -> str: ...


def describe(equilibrium: Equilibrium | Described) -> str:
    """How a solve ended, in words, what is special about the equilibrium, and the estimated errors of its mesh.

    Of several: each with its count, and the largest errors of those that converged. Of a harness: of the whole, then
    of each rod.
    """
    if isinstance(equilibrium, Described):
        return equilibrium.in_words()
    instance(equilibrium, "equilibrium", Equilibrium)
    examination = jax.tree.map(np.asarray, examination_of(equilibrium))  # JAX would compile each comparison
    converged, axial_strain = np.asarray(equilibrium.converged), np.asarray(equilibrium.axial_strain)
    potential = np.full(converged.shape, has_potential(equilibrium.scene))
    remarks = {
        "a saddle: there are motions that lower the energy": _index(equilibrium, examination) > 0,
        "neutral: the whole rod can turn about an axis and stays in equilibrium": examination.neutral,
        "critical (a motion has no stiffness left), so that derivatives are not numbers": examination.critical,
        "under loads without a potential, so that no energy tells whether it is stable": ~np.asarray(potential),
        "pressed to nothing somewhere (axial strain below -1): EA is too small": np.any(axial_strain <= -1, axis=-1),
        f"pressed into an obstacle by more than {MOST_PENETRATION:g} of the radius": penetration(equilibrium)
        > MOST_PENETRATION,
    }
    counts = {remark: int(np.sum(np.asarray(holds) & converged)) for remark, holds in remarks.items()}
    strain = [largest_strain(equilibrium)] if np.any(_is_overstretched(equilibrium)) else []
    told = _errors_told(equilibrium)
    if converged.ndim == 0:
        special = [remark for remark, count in counts.items() if count]
        return "; ".join([outcome_told(equilibrium), *strain, *special, *_contacts_told(equilibrium), *told])
    special = [f"{count} {remark}" for remark, count in counts.items() if count]
    return "\n".join([outcome_told(equilibrium), *strain, *special, *told])


def _index(equilibrium: Equilibrium, examination: Examination) -> Int[np.ndarray, "..."]:
    return np.asarray(examination.index if equilibrium.free_index is None else equilibrium.free_index)


def _is_overstretched(equilibrium: Equilibrium) -> Bool[np.ndarray, "..."]:
    return np.asarray(equilibrium.status) == Status.OVERSTRETCHED


def largest_strain(equilibrium: Equilibrium) -> str:
    """The largest |axial strain| among the overstretched rods, and where it is."""
    strain = np.asarray(equilibrium.axial_strain)
    size = np.where(_is_overstretched(equilibrium)[..., None], np.abs(strain), 0.0)
    *case, node = np.unravel_index(np.argmax(size), size.shape)
    place = f"{100 * strain[(*case, node)]:+.3g} % at s = {float(np.asarray(equilibrium.s)[(*case, node)]):.4g} m"
    numbers = ", ".join(str(int(k)) for k in case)
    return f"largest axial strain {place}" + (f" of case {numbers}" if case else "")


def _contacts_told(equilibrium: Equilibrium) -> list[str]:
    """Of one equilibrium, which obstacles push on the rod, and where it pushes on itself, how much and where."""
    told = []
    if not bool(equilibrium.converged):
        return told
    if equilibrium.scene.self_contact:
        told += _self_contacts_told(equilibrium)
    if not equilibrium.scene.obstacles:
        return told
    s, contacts = np.asarray(equilibrium.s), jax.tree.map(np.asarray, applied_forces.contacts(equilibrium))
    for k, forces in enumerate(contacts.forces - contacts.friction):
        touched = s[np.linalg.norm(forces, axis=-1) > 0]
        if touched.size:
            first, last = float(touched[0]), float(touched[-1])
            where = f"at s = {first:.4g} m" if first == last else f"between s = {first:.4g} and {last:.4g} m"
            name = obstacle_name(equilibrium.scene.obstacles[k], k)
            pushes = f"{name} pushes with {np.linalg.norm(forces.sum(0)):.4g} N {where}"
            told.append(pushes + _friction_told(equilibrium, contacts, k))
    return told


def _self_contacts_told(equilibrium: Equilibrium) -> list[str]:
    found = jax.tree.map(np.asarray, equilibrium.self_contacts)
    forces = np.linalg.norm(found.forces, axis=-1)
    in_contact = np.flatnonzero(forces > 0)
    if not in_contact.size:
        return ["does not touch itself"]
    s, beyond = found.s[in_contact], found.beyond[in_contact]
    most = in_contact[np.argmax(forces[in_contact])]
    where = f"s = {s.min():.4g} to {s.max():.4g} m and s = {beyond.min():.4g} to {beyond.max():.4g} m"
    if in_contact.size == 1:
        where = f"s = {s[0]:.4g} m and s = {beyond[0]:.4g} m"
    places = "place" if in_contact.size == 1 else "places"
    return [f"touches itself at {in_contact.size} {places}, {where}, the largest force {forces[most]:.4g} N"]


def _friction_told(equilibrium: Equilibrium, contacts: applied_forces.Contacts, k: int) -> str:
    if equilibrium.scene.obstacles[k].friction is None:
        return ""
    friction = equilibrium.state.friction
    if friction is None or np.any(np.isnan(friction.reference)):
        return ", without friction as from rest"
    drag = np.linalg.norm(contacts.friction[k].sum(0))
    sticks, slips = (int(np.sum(contacts.states[k] == state)) for state in (STICKS, SLIPS))
    return f", drags with {drag:.4g} N, sticks at {sticks} nodes and slips at {slips}"


def _errors_told(equilibrium: Equilibrium) -> list[str]:
    """The estimated errors, of several the largest; nothing where there are none."""
    converged = np.asarray(equilibrium.converged)
    if equilibrium.discretization == "continuum" or not np.any(converged):
        return []
    errors = estimated_errors(equilibrium)
    sizes = (
        np.max(np.linalg.norm(errors.nodes, axis=-1), axis=-1),
        errors.force,
        moment_error_of(errors),
        errors.curvature,
    )
    shape, *others = (float(np.max(np.asarray(size)[converged])) for size in sizes)
    force, moment, curvature = (f"{100 * error:.2g} %" for error in others)
    return [
        f"estimated errors on {equilibrium.s.shape[-1] - 1} segments: shape {shape:.1e} of the length, forces {force}, "
        f"moments {moment}, curvature {curvature} of the largest"
    ]


def outcome_told(equilibrium: Equilibrium) -> str:
    codes, counts = np.unique(np.asarray(equilibrium.status), return_counts=True)
    messages = {code: Status(code).message for code in codes}
    if Status.PASSED_THROUGH in messages:
        messages[Status.PASSED_THROUGH] += "".join(f" ({part})" for part in _passages(equilibrium))
    if equilibrium.status.ndim == 0:
        clips = "".join(f", {part}" for part in _last_clips(equilibrium))
        told = "".join(f"; {part}" for part in _stuck_within(equilibrium) + too_short(equilibrium))
        return (
            f"{messages[codes[0]]}{clips}; residual {float(equilibrium.residual):.1e} EI/L^2 "
            f"after {int(equilibrium.iterations)} iterations{told}"
        )
    return "\n".join(f"{count} {messages[code]}" for code, count in zip(codes, counts, strict=True))


def places_told(equilibrium: Equilibrium) -> list[str]:
    """Of one that found no equilibrium: the obstacles that it came through or lies in, and the clips that it leaves."""
    return _passages(equilibrium) + _last_clips(equilibrium) + _stuck_within(equilibrium)


def _last_clips(equilibrium: Equilibrium) -> list[str]:
    """Which clips hold nothing any more, or have come to the next one."""
    if equilibrium.status != Status.SLID_OUT:
        return []
    scene = equilibrium.scene
    length = float(scene.rod.length)
    places = np.array([0.0, *(float(clip.at) for clip in scene.clips), length])
    near = np.diff(places) < NEARLY_OUT * length
    which = [k for k, clip in enumerate(scene.clips) if clip.sliding and (near[k] or near[k + 1])]
    return [f"clips[{k}], which has come to {places[k + 1]:.4g} of {length:.4g} m" for k in which]


def _stuck_within(equilibrium: Equilibrium) -> list[str]:
    """In which obstacle a rod lies that found no equilibrium, and where."""
    if bool(equilibrium.converged) or equilibrium.status == Status.PASSED_THROUGH or not equilibrium.scene.obstacles:
        return []
    found = passage_of(equilibrium)
    return [f"the rod lies {_place_of(found, equilibrium)}"] if found.is_within else []


def too_short(equilibrium: Equilibrium) -> list[str]:
    """By how much a rod that found no equilibrium, or a far too strained one, is shorter than a string that is pulled
    taut around the obstacles on the side where the rod last was sound.
    """
    scene, before = equilibrium.scene, equilibrium.state.before
    start, end = scene.start, scene.end
    if before is None or not isinstance(start, Held) or not isinstance(end, Held) or scene.clips:
        return []
    if bool(equilibrium.converged) and not bool(_is_overstretched(equilibrium)):
        return []
    radius, length = least_radius(scene.rod), float(scene.rod.length)
    ends = np.asarray(start.position), np.asarray(end.position)
    points = np.asarray(before.points).copy()
    points[0], points[-1] = ends
    distances = np.min([np.asarray(obstacle.distance(points[1:-1])) for obstacle in scene.obstacles], axis=0)
    if not np.all(distances > 0):  # it began on no side
        return []
    needed, touched = taut(leaf(points), scene.obstacles, leaf(np.asarray(radius)))
    lacking = float(needed) - length
    if lacking < LEAST_LACKING * length:
        return []
    names = [f"obstacles[{k}] ({type(scene.obstacles[k]).__name__})" for k in np.flatnonzero(np.asarray(touched))]
    where = f" to pass {' and '.join(names)} on the side where it was" if names else " to reach from end to end"
    return [f"the rod is at least {lacking:.2g} m too short{where}"]


def least_radius(rod: Rod) -> float:
    """The least of the numbers of the radius along a rod: those between which it varies are not smaller."""
    assert rod.radius is not None
    return float(np.min(np.asarray(getattr(rod.radius, "values", rod.radius))))


def _passages(equilibrium: Equilibrium) -> list[str]:
    """Which obstacles those that came through one did, and where."""
    if not np.any(equilibrium.status == Status.PASSED_THROUGH):
        return []
    found = passage_of(equilibrium)
    passed = np.argwhere((np.asarray(equilibrium.status) == Status.PASSED_THROUGH) & ~np.asarray(found.is_sound))
    named = []
    for index in map(tuple, passed[:MOST_NAMED]):
        which = f"{list(map(int, index))}: " if index else ""
        named.append(which + _place_of(found, equilibrium, index))
    more = [f"and {len(passed) - MOST_NAMED} more"] if len(passed) > MOST_NAMED else []
    return [", ".join([*named, *more])] if named else []


def _place_of(found: Passage, equilibrium: Equilibrium, index: tuple[int, ...] = ()) -> str:
    k, s = int(found.obstacle[index]), float(found.place[index] * equilibrium.scene.rod.length[index])
    how = "within" if found.is_within[index] else "through"
    return f"{how} obstacles[{k}] ({type(equilibrium.scene.obstacles[k]).__name__}) at s = {s:.4g} m"
