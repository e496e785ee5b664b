"""Is it quick enough for a hand in virtual reality?

One end of a cable is held by a hand that moves and turns at random, 90 times a second, by a few millimetres and degrees
at most; every move is a scene, solved from the last result as an application would call it. What counts is the slowest
of thousands of moves: a picture is due every 11 ms.
"""

import argparse
import gc
import math
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure
from measuring import conditions, machine, save_rows, set_up
from scipy.spatial.transform import Rotation

import rodjax
from rodjax import problems
from rodjax.solving.options import Discretization

PICTURE_MS = 1e3 / 90
LARGEST_MOVE = 5e-3  # [m], of the end in one scene
LARGEST_TURN = math.radians(3.0)  # of the end frame in one scene
NEAREST, FARTHEST = 0.3, 0.9  # from the other end [m]; the cable is 1 m long
# A hand as a damped mass on a spring about its place, pushed at random. Per scene: the share of the velocity that is
# lost, the share of the way from its place that pulls it back, and the push in largest moves. So each of the six
# components of its pose roams about ten largest moves: 50 mm and half a radian.
DAMPING, SPRING, PUSH = 0.05, 1e-3, 0.1
WARM_UP = 20  # first scenes, among them the one that compiles, which do not count


class Row(NamedTuple):
    """Latencies [ms] of a stream of scenes: from the call to the nodes in an array of numpy."""

    scene: str
    discretization: str
    segments: int
    called: str
    moves: int
    median: float
    percent_99: float
    percent_99_9: float
    worst: float
    late: int  # slower than a picture
    not_converged: int
    iterations_median: float
    iterations_max: int
    scene_median: float  # to make the scene, apart from the solve
    scene_99: float


class Stream(NamedTuple):
    """What every move took, and how its solve ended."""

    solve_ms: Float[np.ndarray, "moves"]
    scene_ms: Float[np.ndarray, "moves"]
    iterations: np.ndarray
    converged: np.ndarray


Solve = Callable[[rodjax.Scene, rodjax.Equilibrium], rodjax.Equilibrium]


def hand(
    begin: rodjax.Clamp, origin: Float[np.ndarray, "3"], moves: int, seed: int
) -> tuple[Float[np.ndarray, "moves 3"], Float[np.ndarray, "moves 3 3"]]:
    """Positions [m] and frames of a clamp in a wandering hand; `origin` is the other end of the cable."""
    rng = np.random.default_rng(seed)
    limits = np.array([[LARGEST_MOVE], [LARGEST_TURN]])
    pose, velocity = np.zeros((2, 3)), np.zeros((2, 3))  # displacement and rotation vector
    poses = []
    for _ in range(moves):
        velocity = (1 - DAMPING) * velocity - SPRING * pose + PUSH * limits * rng.normal(size=(2, 3))
        velocity *= np.minimum(1.0, limits / np.linalg.norm(velocity, axis=1, keepdims=True))
        pose = pose + velocity
        poses.append(pose)
    displacements, turns = np.swapaxes(poses, 0, 1)
    away = np.asarray(begin.position) + displacements - origin
    reach = np.linalg.norm(away, axis=1, keepdims=True)
    positions = origin + away * np.clip(reach, NEAREST, FARTHEST) / reach
    return positions, Rotation.from_rotvec(turns).as_matrix() @ np.asarray(begin.frame)


def moved(scene: rodjax.Scene, position: Float[np.ndarray, "3"], frame: Float[np.ndarray, "3 3"]) -> rodjax.Scene:
    """The scene with its end where the hand is, made anew as an application would."""
    return rodjax.Scene(scene.rod, scene.start, rodjax.Clamp(position, frame), gravity=scene.gravity)


def streamed(scene: rodjax.Scene, first: rodjax.Equilibrium, positions, frames, solve: Solve) -> Stream:
    """Scene after scene, each from the last result."""
    last, records = first, []
    for position, frame in zip(positions, frames, strict=True):
        begin = time.perf_counter()
        next_scene = moved(scene, position, frame)
        made = time.perf_counter()
        last = solve(next_scene, last)
        np.asarray(last.nodes)  # on the host, for the picture
        records.append((time.perf_counter() - made, made - begin, last.iterations, last.converged))
    solve_s, scene_s, iterations, converged = zip(*records[WARM_UP:], strict=True)
    return Stream(1e3 * np.array(solve_s), 1e3 * np.array(scene_s), np.array(iterations), np.array(converged))


@contextmanager
def collection(mode: str) -> Iterator[None]:
    """Python's garbage collection as it is, blind to what exists already (`gc.freeze`), or off."""
    gc.collect()
    if mode == "frozen":
        gc.freeze()
    if mode == "off":
        gc.disable()
    try:
        yield
    finally:
        gc.enable()
        gc.unfreeze()


def row(name: str, discretization: str, segments: int, called: str, stream: Stream) -> Row:
    median, percent_99, percent_99_9 = np.percentile(stream.solve_ms, [50, 99, 99.9])
    return Row(
        scene=name,
        discretization=discretization,
        segments=segments,
        called=called,
        moves=len(stream.solve_ms),
        median=float(median),
        percent_99=float(percent_99),
        percent_99_9=float(percent_99_9),
        worst=float(np.max(stream.solve_ms)),
        late=int(np.sum(stream.solve_ms > PICTURE_MS)),
        not_converged=int(np.sum(~stream.converged)),
        iterations_median=float(np.median(stream.iterations)),
        iterations_max=int(np.max(stream.iterations)),
        scene_median=float(np.median(stream.scene_ms)),
        scene_99=float(np.percentile(stream.scene_ms, 99)),
    )


# How the solve is called, the garbage collection, and whether the hand moves. A hand at rest takes no iterations: what
# is left is the way into the compiled program and back, with the machine's own delays.
CALLS = (
    ("rodjax.solve", "as it is", True),
    ("jax.jit of it", "as it is", True),
    ("rodjax.solve", "frozen", True),
    ("rodjax.solve", "off", True),
    ("rodjax.solve", "as it is", False),
)


def title(called: str, mode: str, moves: bool) -> str:
    return called + ("" if mode == "as it is" else f", gc {mode}") + ("" if moves else ", hand at rest")


def streams(
    scene: rodjax.Scene,
    guess: rodjax.Guess | None,
    segments: int,
    discretization: Discretization,
    count: int,
    seed: int,
) -> dict[str, Stream]:
    """Every way of calling, on the same hand."""
    assert isinstance(scene.end, rodjax.Clamp)
    assert isinstance(scene.start, rodjax.Clamp)
    positions, frames = hand(scene.end, np.asarray(scene.start.position), count + WARM_UP, seed)

    def eager(scene: rodjax.Scene, guess: rodjax.Equilibrium) -> rodjax.Equilibrium:
        return rodjax.solve(scene, segments=segments, discretization=discretization, guess=guess)

    first = rodjax.solve(scene, segments=segments, discretization=discretization, guess=guess)
    solves: dict[str, Solve] = {"rodjax.solve": eager, "jax.jit of it": jax.jit(eager)}
    found = {}
    for called, mode, moves in CALLS:
        at, held = (positions, frames) if moves else (positions[:1].repeat(len(positions), 0), frames[:1])
        with collection(mode):
            stream = streamed(scene, first, at, np.broadcast_to(held, frames.shape), solves[called])
        found[title(called, mode, moves)] = stream
    return found


HEADER = (
    f"{'':8}{'':5}{'':28}|{'latency of a move [ms]':^36}|{'later than':>11}{'not con-':>9} |{'iterations':^13}"
    f"|{'making a scene [ms]':^20}\n"
    f"{'scene':8}{'N':>5}  {'called':26}|{'median':>9}{'99 %':>9}{'99.9 %':>9}{'worst':>9}|"
    f"{f'{PICTURE_MS:.1f} ms':>11}{'verged':>9} |{'median':>7}{'max':>6}|{'median':>10}{'99 %':>10}"
)


def line(row: Row) -> str:
    return (
        f"{row.scene:8}{row.segments:5}  {row.called:26}|{row.median:9.3f}{row.percent_99:9.3f}"
        f"{row.percent_99_9:9.3f}{row.worst:9.3f}|{row.late:11}{row.not_converged:9} |{row.iterations_median:7.0f}"
        f"{row.iterations_max:6}|{row.scene_median:10.3f}{row.scene_99:10.3f}"
    )


def picture(found: dict[tuple[str, int], dict[str, Stream]], discretization: str) -> Figure:
    """The share of moves that took longer than a time, one panel a scene; dashed through `jax.jit`."""
    names = list(dict.fromkeys(name for name, _ in found))
    figure = Figure(figsize=(7 * len(names), 4.8), layout="constrained")
    panels = figure.subplots(1, len(names), sharey=True, squeeze=False)[0]
    for axes, name in zip(panels, names, strict=True):
        for k, segments in enumerate(segments for scene, segments in found if scene == name):
            for called, style in (("rodjax.solve", "-"), ("jax.jit of it", "--"), ("rodjax.solve, hand at rest", ":")):
                ms = np.sort(found[name, segments][called].solve_ms)
                share = 1 - np.arange(len(ms)) / len(ms)
                axes.loglog(ms, share, style, color=f"C{k}", drawstyle="steps-post", label=f"N = {segments}: {called}")
        axes.axvline(PICTURE_MS, color="0.5", lw=1)
        axes.text(PICTURE_MS, 1e-2, "90 Hz ", color="0.4", ha="right")
        axes.set(xlabel="latency [ms]", title=f"{name}: share of moves that took longer")
        axes.grid(color="0.92")
    panels[0].set_ylabel("share of moves")
    panels[0].legend(fontsize=8)
    figure.suptitle(
        f"A hand moves the end of a cable, {discretization}; {machine()}, one thread, double precision", fontsize=10
    )
    return figure


def main(argv: Sequence[str] | None = None) -> list[Row]:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--segments", type=int, nargs="+", default=[10, 50, 100])
    parser.add_argument("--discretization", choices=["finite_difference", "hermite"], default="finite_difference")
    parser.add_argument("--scene", nargs="+", choices=["hanging", "Omega"], default=["hanging", "Omega"])
    parser.add_argument("--moves", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, help="folder for interactive.csv and interactive.png")
    arguments = parser.parse_args(argv)
    set_up()
    scenes: dict[str, tuple[rodjax.Scene, rodjax.Guess | None]] = {
        "hanging": (problems.hanging_cable(span=problems.SPAN), None),
        "Omega": (problems.omega(math.pi / 6, 0.0), problems.figure_1_start()),
    }
    discretization: Discretization = arguments.discretization
    print(f"{arguments.moves} moves, seed {arguments.seed}, {discretization}; {conditions()}")
    print(HEADER)
    rows, found = [], {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", rodjax.NotConvergedWarning)  # the table counts them
        for name in arguments.scene:
            scene, guess = scenes[name]
            for segments in arguments.segments:
                here = streams(scene, guess, segments, discretization, arguments.moves, arguments.seed)
                found[name, segments] = here
                some = [row(name, discretization, segments, called, stream) for called, stream in here.items()]
                print("\n".join(map(line, some)), flush=True)
                rows += some
    if arguments.out is not None:
        save_rows(rows, arguments.out / "interactive.csv")
        picture(found, discretization).savefig(arguments.out / "interactive.png", dpi=110)
    return rows


if __name__ == "__main__":
    main()
