"""tolerances(): how far a rod or harness at rest scatters where its numbers do, and how likely it breaks its limits.

To first order: the derivatives J of all quantities by the tolerated numbers, through the implicit function theorem, and
J Sigma J^T. Whether the first order is enough is looked at by a few solves at distances of sqrt(3) standard deviations,
which is the three-point rule of Gauss & Hermite along each direction. Where it is not, a Monte Carlo of solves follows,
and its numbers come first.
"""

import dataclasses
import math
from collections.abc import Sequence
from concurrent.futures import Executor
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import linalg, stats

from rodjax.analysis.sensitivity import named_numbers
from rodjax.checks import Numbers, instance, is_known, leaf, number_array, positive, sequence, shown, whole_number
from rodjax.identification.unknowns import Unknown, known_names, target
from rodjax.model.harness import Harness, check_without_friction
from rodjax.model.scene import Scene
from rodjax.programs.answers import one_answer
from rodjax.programs.tasks import Workers, checked_executor, checked_threads
from rodjax.routing.limits import Limits
from rodjax.routing.margins import Margins, margins
from rodjax.routing.scatter import Moments, Quantities, Scattering, by_derivatives, by_few, by_samples
from rodjax.solving.harness_result import HarnessEquilibrium, Solution, results_of, solved_in
from rodjax.solving.result import Equilibrium
from rodjax.solving.status import Status

# Standard deviations that differ by this part, and means by this part of a standard deviation, are flagged: in a tail
# at two standard deviations the two weigh the same.
SPREAD, SHIFT = 0.05, 0.1
# A Monte Carlo may differ by so many of its own standard errors besides.
ERRORS = 2.0
# A scatter below this part of the quantity is that of what a solve leaves, and not compared.
LEAST_SCATTER = 1e-6
# Where the stiffness of the softest motion vanishes within so many standard deviations, the rod is near instability.
NEAR = 3.0
# Draws from the normal distribution of the first order, for the probability that any limit is broken.
DRAWS = 100_000
MOST_SAMPLES = 10_000_000
# Samples where the first order is not enough and none are asked for: a probability of 0.2 to 0.01.
SAMPLES = 2000
NOT_FINITE = "not finite as it should be, so that nothing can be said to first order"


class Tolerance:
    """The scatter of a number of a scene or harness, or of each component of a vector.

    **Arguments:**

    - `key`: dotted name of a number or vector, `"rod.length"`, `"clips.0.at"`, `"clips.0.position"`,
        `"end.position.2"`; or of a direction or frame, `"clips.0.tangent"`, which turns about the global axes [rad].
        Of a harness `"cables.NAME.rod.length"`, of the scene of a cable, and `"joints.NAME.mass"`, of a `Body`.
    - `sigma`: the standard deviation in SI units, of a vector of each component; or its (n, n) covariance matrix.

    Raises `ValueError` or `TypeError` where it is not positive, or the matrix not symmetric and positive. Whether the
    scene has such a number `rodjax.tolerances` finds out.
    """

    def __init__(self, key: str, sigma: Any):
        if not isinstance(key, str) or not key:
            raise TypeError(f"key must be the dotted name of a number such as 'clips.0.position', got {shown(key)}")
        self.key = key
        shape = np.shape(sigma) if is_known(sigma) else ()
        if len(shape) == 2 and shape[0] == shape[1] and shape[0]:
            self.sigma: float | Float[np.ndarray, "n n"] = _covariance(sigma, shape)
        else:
            self.sigma = float(positive(sigma, "sigma"))
        self.unit = Unknown(key).unit

    def __repr__(self) -> str:
        return f"Tolerance({self.key!r}, {self.sigma!r})"


def _covariance(sigma: Any, shape: tuple[int, ...]) -> Float[np.ndarray, "n n"]:
    matrix = np.asarray(number_array(sigma, "sigma", shape), float)
    largest = float(np.max(np.abs(matrix)))
    # Roundings of a matrix that somebody computed.
    if np.max(np.abs(matrix - matrix.T)) > 1e-9 * largest or np.min(np.linalg.eigvalsh(matrix)) < -1e-9 * largest:
        raise ValueError(f"sigma must be a covariance matrix, symmetric and not negative, got {shown(sigma)}")
    return matrix


@dataclasses.dataclass(frozen=True)
class Scatter:
    """Of a normal distribution, or of samples: what an `Envelope` holds of each.

    - `deviation` (m,): standard deviations of the values; `probability` (m,) that each breaks its limit
    - `any_broken`: the probability that any does
    - `position` (n+1,) m: largest standard deviation of the centerline at each node across itself, and at a free end in
      any direction
    - `start_force`, `end_force` (3,) N: standard deviations

    Of a harness `position` has the nodes of all cables, one cable after another, and the forces are (cables, 3).
    """

    deviation: Float[np.ndarray, "m"]
    probability: Float[np.ndarray, "m"]
    any_broken: float
    position: Float[np.ndarray, "n+1"]
    start_force: Float[np.ndarray, "... 3"]
    end_force: Float[np.ndarray, "... 3"]

    @staticmethod
    def of(
        scattering: Scattering, moments: Moments, probability: Float[np.ndarray, "m"], any_broken: float
    ) -> "Scatter":
        # Of what does not scatter, roundings may be left of either sign.
        forces = np.sqrt(np.maximum(np.diagonal(moments.forces, axis1=1, axis2=2), 0.0))
        forces = forces if isinstance(scattering.equilibrium, Equilibrium) else forces.reshape(-1, 2, 3).swapaxes(0, 1)
        return Scatter(np.sqrt(moments.values), probability, any_broken, _largest(moments.nodes), *forces)


class CableScatter(NamedTuple):
    """Of one cable of a harness: arclengths `s` (n+1,) m of its nodes, and the others as of `Scatter`."""

    s: Float[np.ndarray, "n+1"]
    position: Float[np.ndarray, "n+1"]
    start_force: Float[np.ndarray, "3"]
    end_force: Float[np.ndarray, "3"]


@dataclasses.dataclass(frozen=True)
class Envelope:
    """How a rod or harness at rest scatters with its tolerances; of a harness `envelope["trunk"]` is the `CableScatter`
    of a cable.

    - `margins`: `Margins` of the rod as it should be, m of them; none without limits
    - `first_order`: `Scatter` by the derivatives; `any_bound`: the sum of its probabilities, which that of any limit
      being broken cannot exceed
    - `shares` (m, k): the part of the variance of each value that each tolerance brings
    - `s` (n+1,) m: arclengths of the nodes, of a harness those of one cable after another
    - `stiffness`, `stiffness_deviation` N: of the softest motion, as by `rodjax.lowest_mode`, not numbers where that
      has none
    - `sampled`: `Scatter` of the Monte Carlo, `None` without samples; `samples`: how many of its solves converged
    - `scatter`: that of the two which holds: `sampled` where something is flagged and there are samples, else
      `first_order`; `is_certain`: whether one does
    - `scattering`: what scatters: the `equilibrium`, the `limits` and `obstacles` of the margins
    - `flags`: sentences by what they concern, where the first order is not enough: names of the margins, "centerline",
      "start_force", "end_force", of a harness "trunk: centerline" and so on, or of all "rod"
    """

    tolerances: tuple[Tolerance, ...]
    margins: Margins | None
    first_order: Scatter
    any_bound: float
    shares: Float[np.ndarray, "m k"]
    s: Float[np.ndarray, "n+1"]
    stiffness: float
    stiffness_deviation: float
    sampled: Scatter | None
    samples: int
    scattering: Scattering
    flags: dict[str, str]

    def __getitem__(self, cable: str) -> CableScatter:
        """Of a cable of a harness, by what holds. Raises `KeyError` where there is none of this name."""
        equilibrium = self.scattering.equilibrium
        if isinstance(equilibrium, Equilibrium) or cable not in equilibrium.names:
            known = "" if isinstance(equilibrium, Equilibrium) else ", ".join(map(repr, equilibrium.names))
            raise KeyError(f"no cable {cable!r} in this envelope: it is of {known or 'a single rod'}")
        part = self.scattering.parts[equilibrium.names.index(cable)]
        forces = self.scatter.start_force[part.number], self.scatter.end_force[part.number]
        return CableScatter(self.s[part.nodes], self.scatter.position[part.nodes], *forces)

    def drawn(self, count: int, seed: int = 0) -> Any:
        """So many scenes, drawn at random within the tolerances, as one `Scene` or `Harness` with a leading axis.
        `rodjax.view(envelope)` shows such rods, `rodjax.solve_batch(envelope.drawn(100), segments=32)` solves them.
        """
        count = whole_number(count, "count", 1, MOST_SAMPLES)
        rng = np.random.default_rng(whole_number(seed, "seed", 0, 2**63))
        return self.scattering.scenes(rng.standard_normal((count, len(self.scattering.keys))))

    @property
    def scatter(self) -> Scatter:
        return self.first_order if self.sampled is None or not _is_in_doubt(self.flags) else self.sampled

    @property
    def is_certain(self) -> bool:
        return self.sampled is not None or not _is_in_doubt(self.flags)

    def __str__(self) -> str:
        """One line for each limit and one for the envelope, what holds first; then what is flagged."""
        leading = self.scatter
        is_sampled = leading is self.sampled
        other = self.first_order if is_sampled else self.sampled
        beside = "to first order, which does not hold," if is_sampled else "sampled"
        lines = []
        if is_sampled:
            lines.append(f"By {self.samples} samples, as the first order does not hold for {', '.join(self.flags)}:")
        elif not self.is_certain:
            lines.append(
                f"To first order, which does NOT hold for {', '.join(self.flags)}: samples={SAMPLES} tells what does"
            )
        names = self.margins.names if self.margins else ()
        for k, name in enumerate(names):
            assert self.margins is not None
            text = f"{name}: {self.margins.value[k]:.4g} +- {leading.deviation[k]:.2g} {self.margins.units[k]}"
            text += f" ({self.margins.kinds[k]} {self.margins.limit[k]:.4g})"
            text += f", broken with probability {leading.probability[k]:.2g}"
            if other is not None:
                text += f"; {beside} +- {other.deviation[k]:.2g}, {other.probability[k]:.2g}"
            lines.append(text)
        if names:
            text = f"any limit broken with probability {leading.any_broken:.2g}"
            text += "" if is_sampled else f", at most {self.any_bound:.2g}"
            lines.append(text if other is None else f"{text}; {beside} {other.any_broken:.2g}")
        for part in self.scattering.parts:
            of_rod, s = leading.position[part.nodes], self.s[part.nodes]
            k = int(np.nanargmax(of_rod)) if np.any(np.isfinite(of_rod)) else 0
            text = f"{part.prefix}centerline: +- {of_rod[k]:.2g} m at most, at s = {s[k]:.4g} m"
            lines.append(text if other is None else f"{text}; {beside} {np.max(other.position[part.nodes]):.2g}")
        lines += [f"not of first order: {name}: {flag}" for name, flag in self.flags.items()]
        return "\n".join(lines)


@one_answer
def tolerances(
    equilibrium: Solution,
    tolerances: Sequence[Tolerance],
    *,
    limits: Limits | None = None,
    obstacles: Any = (),
    names: Any = None,
    samples: int | None = None,
    seed: int = 0,
    executor: Executor | None = None,
    threads: int | None = None,
    progress: bool | None = None,
) -> Envelope:
    """The scatter of an equilibrium whose scene or harness has numbers with tolerances, normally distributed and
    independent.

    **Arguments:**

    - `equilibrium`: a single one that converged, on its mesh.
    - `tolerances`: a list of `Tolerance`.
    - `limits`, `obstacles`, `names`: as for `rodjax.margins`, which are then looked at, of a harness those of every
        cable; `None` for the shape and the forces alone.
    - `samples`: solves of a Monte Carlo, warm from the equilibrium, besides the first order; `None`: a few solves that
        tell whether the first order is enough, and where it is not, 2000 samples; 0: the few solves alone.
    - `seed`: of the random numbers.
    - `executor`: what solves the samples, anything with the interface of `concurrent.futures.Executor`, such as
        `client.get_executor()` of Dask; `None`: threads of this process.
    - `threads`: how many, `None`: the environment variable `RODJAX_THREADS`, or one for each core. Neither changes the
        result.
    - `progress`: whether a bar on stderr tells of it; `None`: in a terminal or notebook, after 2 s.

    Flagged are quantities whose standard deviation by the solves differs by more than 5 % from that of the first order,
    or whose mean is off by more than a tenth of it, both beyond what so few samples may be off by (two standard
    errors); solves that do not converge; and the rod where the stiffness of its softest motion vanishes within three
    standard deviations (not of harnesses with contact between rods, whose softest motion is not sought). Where the
    equilibrium is critical the first order is not a number, and a flag says so. Samples of harnesses are solved one
    after another.

    Raises `ValueError` or `TypeError` for names that the scene or harness does not have, and for invalid arguments.
    """
    workers = Workers(checked_executor(executor), checked_threads(threads))
    instance(equilibrium, "equilibrium", (Equilibrium, HarnessEquilibrium))
    if not is_known(equilibrium):
        raise ValueError("equilibrium must hold numbers, got a traced one: call tolerances outside jax.jit and vmap")
    if equilibrium.energy.ndim:
        raise ValueError(f"equilibrium must be a single one, got a stack of shape {equilibrium.energy.shape}")
    if isinstance(equilibrium, Equilibrium) and equilibrium.discretization == "continuum":
        raise ValueError("equilibrium must be of elements or finite differences, got one of the continuum")
    if not bool(equilibrium.converged):
        raise ValueError(f"equilibrium must be one: {Status(int(equilibrium.status)).message}")
    check_without_friction(solved_in(equilibrium), "tolerances")
    tolerances = sequence(tolerances, "tolerances", "Tolerance")
    samples = None if samples is None else whole_number(samples, "samples", 0, MOST_SAMPLES)
    rng = np.random.default_rng(whole_number(seed, "seed", 0, 2**63))
    obstacles = sequence(obstacles, "obstacles", "Obstacle")
    if limits is None and obstacles:
        raise ValueError(f"limits must be given where there are obstacles, got {len(obstacles)} of them and no limits")
    kept = None if limits is None else margins(equilibrium, limits, obstacles, names)
    keys, owners, root = _scattering(solved_in(equilibrium), tolerances)
    scattering = Scattering(equilibrium, keys, leaf(root.astype(equilibrium.energy.dtype)), limits, obstacles)
    # Of values that are not finite, as the bend radius of a straight rod, nothing is said but that.
    with np.errstate(invalid="ignore"):
        return _envelope(scattering, tolerances, owners, kept, samples, rng, workers)


def _envelope(
    scattering: Scattering,
    tolerances: tuple[Tolerance, ...],
    owners: Int[np.ndarray, "p"],
    kept: Margins | None,
    samples: int | None,
    rng: np.random.Generator,
    workers: Workers,
) -> Envelope:
    slopes = scattering.slopes()
    first = by_derivatives(slopes)
    values, p = slopes.here.values, len(owners)
    deviation = np.sqrt(first.values)
    s = np.concatenate([np.asarray(rod.s) for rod in results_of(scattering.equilibrium).values()])
    stiffness, stiffness_deviation = float(slopes.stiffness), float(np.linalg.norm(slopes.stiffness_by))
    flags, sampled, count = {}, None, 0

    def flag(unsolved: int, compared: Sequence[Moments], count: int) -> None:
        """What was flagged before stays."""
        found = [_flags_of_rod(stiffness, stiffness_deviation, unsolved, first)]
        found += [_flags(scattering, slopes.here, first, moments, kept, s, count) for moments in compared]
        for each in found:
            for name, told in each.items():
                flags.setdefault(name, told)

    if not samples:
        *few, unsolved = by_few(scattering, slopes, workers)
        flag(unsolved, few, 0)
    if samples or (samples is None and _is_in_doubt(flags)):
        samples = samples or SAMPLES
        second, rods = by_samples(scattering, slopes.here, rng.standard_normal((samples, p)), workers)
        count = len(rods)
        flag(samples - count, [second] if count else [], count)
        is_broken = _broken(rods, kept)
        if count:
            parts = np.mean(is_broken, axis=0), float(np.mean(np.any(is_broken, axis=1)))
            sampled = Scatter.of(scattering, second, *parts)
    probability = _probabilities(values, deviation, kept)
    draws = values[None] + rng.standard_normal((DRAWS, p)) @ slopes.by.values
    any_broken = float(np.max([np.mean(np.any(_broken(draws, kept), axis=1)), *probability]))
    variances = np.stack([np.sum(np.square(slopes.by.values[owners == k]), axis=0) for k in range(len(tolerances))])
    return Envelope(
        tolerances=tolerances,
        margins=kept,
        first_order=Scatter.of(scattering, first, probability, any_broken),
        any_bound=min(1.0, float(np.sum(probability))),
        shares=(variances / np.where(first.values > 0, first.values, 1.0)[None]).T,
        s=s,
        stiffness=stiffness,
        stiffness_deviation=stiffness_deviation,
        sampled=sampled,
        samples=count,
        scattering=scattering,
        flags=flags,
    )


def _scattering(
    scene: Scene | Harness, tolerances: Sequence[Tolerance]
) -> tuple[tuple[str, ...], Float[np.ndarray, "p"], Float[np.ndarray, "p p"]]:
    """The names of the numbers that scatter, which tolerance each is of, and a root of their covariance matrix."""
    if not tolerances:
        raise ValueError("tolerances must hold at least one Tolerance, got none")
    numbers = named_numbers(scene)
    clips = scene.clips if isinstance(scene, Scene) else ()  # none slides on a rod of a harness
    sliding = {f"clips.{k}.at" for k, clip in enumerate(clips) if clip.sliding}
    keys, owners, roots = [], [], []
    for k, tolerance in enumerate(tolerances):
        instance(tolerance, f"tolerances[{k}]", Tolerance)
        key = tolerance.key
        own = [key] if target(key, scene) else [f"{key}.{j}" for j in range(3)]
        if key in numbers and numbers[key].ndim == 1:
            own = [f"{key}.{j}" for j in range(len(numbers[key]))]
        if any(target(name, scene) is None for name in own) or key in sliding:
            allowed = ", ".join(name for name in known_names(scene) if name not in sliding)
            kind = "scene" if isinstance(scene, Scene) else "harness"
            raise ValueError(f"tolerances[{k}]: key must be a number of the {kind}: {allowed}; got {key!r}")
        repeated = [name for name in own if name in keys]
        if repeated:
            raise ValueError(f"tolerances[{k}]: {repeated[0]} has a tolerance already, got {key!r}")
        if not isinstance(tolerance.sigma, np.ndarray):
            roots.append(tolerance.sigma * np.eye(len(own)))
        else:
            if len(tolerance.sigma) != len(own):
                raise ValueError(
                    f"tolerances[{k}]: sigma must be a number or of shape {(len(own), len(own))} for {key}, "
                    f"got {tolerance.sigma.shape}"
                )
            squares, directions = np.linalg.eigh(tolerance.sigma)
            roots.append(directions * np.sqrt(np.maximum(squares, 0.0)))
        keys += own
        owners += [k] * len(own)
    return tuple(keys), np.array(owners), np.asarray(linalg.block_diag(*roots))


def _broken(values: Float[Numbers, "k m"], kept: Margins | None) -> Bool[np.ndarray, "k m"]:
    if kept is None:
        return np.zeros(values.shape, bool)
    sign = np.where(np.array(kept.kinds) == "least", 1.0, -1.0)
    return sign * (values - np.asarray(kept.limit)) < 0


def _probabilities(
    values: Float[Numbers, "m"], deviation: Float[np.ndarray, "m"], kept: Margins | None
) -> Float[np.ndarray, "m"]:
    """That normal values break their limits."""
    if kept is None:
        return np.zeros_like(values)
    sign = np.where(np.array(kept.kinds) == "least", 1.0, -1.0)
    gap = sign * (values - np.asarray(kept.limit))
    with np.errstate(divide="ignore", invalid="ignore"):
        normal = stats.norm.sf(gap / deviation)
    return np.where(deviation == 0, np.where(gap < 0, 1.0, 0.0), normal)


def _largest(covariances: Float[np.ndarray, "k 3 3"]) -> Float[np.ndarray, "k"]:
    """Standard deviations in the directions in which they are largest."""
    is_finite = np.all(np.isfinite(covariances), axis=(1, 2))
    values = np.linalg.eigvalsh(np.where(is_finite[:, None, None], covariances, 0.0))[:, -1]
    return np.where(is_finite, np.sqrt(np.maximum(values, 0.0)), np.nan)


# --- where the first order is not enough -----------------------------------------------------------------------------


def _is_in_doubt(flags: dict[str, str]) -> bool:
    """Whether the first order is wrong of something; a straight rod has no bend radius, which is no doubt."""
    return any(flag != NOT_FINITE for flag in flags.values())


def _flags_of_rod(stiffness: float, deviation: float, unsolved: int, first: Moments) -> dict[str, str]:
    told = []
    if not all(np.all(np.isfinite(x)) for x in (first.nodes, first.forces)):
        told.append("the equilibrium is critical, so that derivatives are not numbers")
    elif stiffness - NEAR * deviation <= 0:
        told.append(f"near instability: the softest motion has a stiffness of {stiffness:.3g} +- {deviation:.2g} N")
    if unsolved:
        told.append(f"{unsolved} of the rods with other numbers did not come to rest and are left out")
    return {"rod": "; ".join(told)} if told else {}


def _flags(
    scattering: Scattering,
    here: Quantities,
    first: Moments,
    second: Moments,
    kept: Margins | None,
    s: Float[np.ndarray, "n"],
    count: int,
) -> dict[str, str]:
    """Of what differs between the first order and solves, `count` of them at random, or 0."""
    flags = {}
    for k, name in enumerate(kept.names if kept else ()):
        if not np.isfinite(here.values[k]):
            flags[name] = NOT_FINITE
            continue
        size = max(abs(float(here.values[k])), abs(float(kept.limit[k])) if kept else 0.0)
        spreads = math.sqrt(first.values[k]), math.sqrt(second.values[k])
        flag = _flag(*spreads, abs(float(second.shift.values[k])), size, count)
        if flag:
            flags[name] = flag
    force = float(np.max(np.linalg.norm(here.forces, axis=1)))
    named = {}
    for prefix, nodes, number in scattering.parts:
        spread, solved = (float(np.max(_largest(moments.nodes[nodes]))) for moments in (first, second))
        named[f"{prefix}centerline"] = (spread, solved, second.shift.nodes[nodes], float(s[nodes][-1]))
        for k, end in ((2 * number, "start"), (2 * number + 1, "end")):
            spread, solved = (math.sqrt(max(np.trace(moments.forces[k]), 0.0)) for moments in (first, second))
            named[f"{prefix}{end}_force"] = (spread, solved, second.shift.forces[k][None], force)
    for name, (spread, solved, shifts, size) in named.items():
        flag = _flag(spread, solved, float(np.max(np.linalg.norm(shifts, axis=1))), size, count)
        if flag:
            flags[name] = flag
    return flags


def _flag(first: float, second: float, shift: float, size: float, count: int) -> str | None:
    """In words, where two standard deviations differ, or the mean is off, of a quantity of that size."""
    by_chance = ERRORS / math.sqrt(count) if count else 0.0
    least = LEAST_SCATTER * size
    if not abs(second - first) <= (SPREAD + by_chance / math.sqrt(2)) * first + least:
        return f"its standard deviation by solves is {second:.3g}, to first order {first:.3g}"
    if not shift <= (SHIFT + by_chance) * first + least:
        return f"its mean by solves is off by {shift:.3g}, with a standard deviation of {first:.3g} to first order"
    return None
