"""view(): a window in the browser in which a rod is taken in the hand."""

from collections.abc import Sequence

import jax

from rodjax.checks import instance, is_known
from rodjax.model.harness import Harness
from rodjax.model.obstacles import Obstacle
from rodjax.model.scene import Scene
from rodjax.notes import in_notebook
from rodjax.paths.harness_path import unstacked
from rodjax.routing.limits import Limits
from rodjax.routing.margins import CLEARANCE
from rodjax.routing.route import Route
from rodjax.routing.tolerances import Envelope
from rodjax.solving.harness_result import HarnessEquilibrium, solved_in
from rodjax.solving.result import DEFAULT_STRAIN_LIMIT, Equilibrium
from rodjax.window.browser import Window
from rodjax.window.session import SEGMENTS, Session

# Rods of an envelope that are drawn at random and shown.
DRAWN = 60
Shown = Scene | Harness | Equilibrium | HarnessEquilibrium | Route | Envelope


def view(
    shown: Shown,
    port: int = 8080,
    *,
    host: str = "127.0.0.1",
    open_browser: bool | None = None,
    block: bool | None = None,
    segments: int | None = None,
    limits: Limits | None = None,
    dark: bool = False,
) -> Window:
    """Opens a window in the browser in which ends, clips and obstacles are dragged and turned, and the rod follows.

    It takes `pip install 'rodjax[view]'`. Nothing is loaded from elsewhere, and no file is read or written: what is
    saved goes to the browser's downloads.

    **Arguments:**

    - `shown`: a `Scene` or `Harness`; or an equilibrium of one, with whose shape and turns the rods begin. Of a path or
      a batch, with one leading axis, the last one; all of them are steps of the recording, which can be shown together.
      Of a `Route` the designs at which its search stood are the steps, with its limits and obstacles; of what
      `rodjax.tolerances` returns 60 rods drawn at random are, shown together.
    - `port`: of the server; 0 for any that is free.
    - `host`: the address at which it can be reached, by default by programs of this machine only; whoever reaches it
      can move the rod.
    - `open_browser`: whether the user's browser opens the window at once; `None`: outside of a notebook.
    - `block`: whether to wait for Ctrl-C, and then close; else the window lives until its `close()`; `None`: outside of
      a notebook. There the window shows itself below the cell, as what `view` returns.
    - `segments`: of the mesh; `None`: 32, or those of an `Equilibrium`.
    - `limits`: `rodjax.Limits`, against which the numbers are shown; `None`: those of a route or of tolerances.
    - `dark`: whether the page is dark; it can be changed there.

    Returns the window: its `url`, `session` and `close()`. Raises `ImportError` without viser, `OSError` where the port
    cannot be opened, `ValueError` or `TypeError` for arguments that make no sense or a scene without an equilibrium.
    """
    instance(shown, "shown", (Scene, Harness, Equilibrium, HarnessEquilibrium, Route, Envelope))
    if limits is not None:
        instance(limits, "limits", Limits)
    if isinstance(shown, Route):
        limits = shown.limits if limits is None else limits
    elif isinstance(shown, Envelope):
        limits = shown.scattering.limits if limits is None else limits
    elif not is_known(shown):
        raise ValueError("shown must hold numbers, got traced ones: call view outside jax.jit, vmap and grad")
    session, is_script = session_of(shown, segments), not in_notebook()
    return show(
        session,
        port,
        host,
        is_script if open_browser is None else open_browser,
        is_script if block is None else block,
        limits,
        dark,
        together=isinstance(shown, Envelope),
    )


def show(
    session: Session,
    port: int,
    host: str,
    open_browser: bool,
    block: bool = True,
    limits: Limits | None = None,
    dark: bool = False,
    together: bool = False,
) -> Window:
    """As `view`, of a session; `together`: with all its steps."""
    window = Window(session, port, host, limits, dark, together)
    print(f"rodjax: the window is at {window.url}" + ("; Ctrl-C closes it" if block else ""), flush=True)
    if open_browser:
        window.open()
    if block:
        window.wait()
    return window


def session_of(shown: Shown, segments: int | None, strain_limit: float = DEFAULT_STRAIN_LIMIT) -> Session:
    """A session that begins with what is shown."""
    if isinstance(shown, Route):
        session = _beside(shown.equilibrium, segments, strain_limit, shown.obstacles, shown.obstacle_names)
        # The last design is that of the equilibrium.
        before = jax.tree.map(lambda leaf: leaf[:-1], shown.designs)
        session.add_recorded([*session.solved_in_turn(before, None, is_path=True), session.result])
        return session
    if isinstance(shown, Envelope):
        scattering, margins = shown.scattering, shown.margins
        told = () if margins is None else [name.partition(CLEARANCE) for name in margins.names]
        names = list(dict.fromkeys(obstacle for _, clearance, obstacle in told if clearance))
        session = _beside(scattering.equilibrium, segments, strain_limit, scattering.obstacles, names)
        session.add_recorded(session.solved_in_turn(shown.drawn(DRAWN), session.result, is_path=False))
        return session
    if isinstance(shown, Scene | Harness):
        return Session(shown, segments=SEGMENTS if segments is None else segments, strain_limit=strain_limit)
    axes = shown.status.ndim
    if axes > 1:
        raise ValueError(f"shown must have one leading axis at most, got {shown.status.shape}")
    if isinstance(shown, Equilibrium) and shown.discretization == "continuum":
        raise ValueError("shown must be of elements or finite differences, got one of the continuum")
    last = jax.tree.map(lambda leaf: leaf[-1], shown) if axes else shown
    if segments is None:
        segments = _mesh_of(last)
    session = Session(solved_in(last), segments=segments, guess=last, strain_limit=strain_limit)
    if axes:
        session.add_recorded(unstacked(shown))
    return session


def _mesh_of(result: Equilibrium | HarnessEquilibrium) -> int:
    """The most segments of its rods."""
    return result.s.shape[-1] - 1 if isinstance(result, Equilibrium) else max(result.segments)


def _beside(
    result: Equilibrium | HarnessEquilibrium,
    segments: int | None,
    strain_limit: float,
    obstacles: Sequence[Obstacle],
    names: Sequence[str],
) -> Session:
    """A session that begins with a result beside obstacles that do not touch it."""
    segments = _mesh_of(result) if segments is None else segments
    beside = dict(zip(names, obstacles, strict=True))
    return Session(solved_in(result), segments=segments, guess=result, strain_limit=strain_limit, beside=beside)
