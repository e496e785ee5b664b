"""view(): a window in the browser in which a rod is taken in the hand."""

import jax

from rodjax.checks import instance, is_known
from rodjax.model.harness import Harness
from rodjax.model.scene import Scene
from rodjax.routing.limits import Limits
from rodjax.solving.harness_result import HarnessEquilibrium
from rodjax.solving.result import DEFAULT_STRAIN_LIMIT, Equilibrium
from rodjax.window.browser import Window
from rodjax.window.session import SEGMENTS, Session, scene_in


def view(
    shown: Scene | Harness | Equilibrium | HarnessEquilibrium,
    port: int = 8080,
    *,
    host: str = "127.0.0.1",
    open_browser: bool = True,
    block: bool = True,
    segments: int | None = None,
    limits: Limits | None = None,
) -> Window:
    """Opens a window in the browser in which ends, clips and obstacles are dragged and turned, and the rod follows.

    It takes `pip install 'rodjax[view]'`. Nothing is loaded from elsewhere, and no file is read or written: what is
    saved goes to the browser's downloads.

    **Arguments:**

    - `shown`: a `Scene` or `Harness`; or an equilibrium of one, with whose shape and turns the rods begin. Of a path or
      a batch, with one leading axis, the last one; all of them are steps of the recording, which can be shown together.
    - `port`: of the server; 0 for any that is free.
    - `host`: the address at which it can be reached, by default by programs of this machine only; whoever reaches it
      can move the rod.
    - `open_browser`: whether the user's browser opens the window at once.
    - `block`: whether to wait for Ctrl-C, and then close; else the window lives until its `close()`.
    - `segments`: of the mesh; `None`: 32, or those of an `Equilibrium`.
    - `limits`: `rodjax.Limits`, against which the numbers are shown.

    Returns the window: its `url`, `session` and `close()`. Raises `ImportError` without viser, `OSError` where the port
    cannot be opened, `ValueError` or `TypeError` for arguments that make no sense or a scene without an equilibrium.
    """
    instance(shown, "shown", (Scene, Harness, Equilibrium, HarnessEquilibrium))
    if limits is not None:
        instance(limits, "limits", Limits)
    if not is_known(shown):
        raise ValueError("shown must hold numbers, got traced ones: call view outside jax.jit, vmap and grad")
    return show(session_of(shown, segments), port, host, open_browser, block, limits)


def show(
    session: Session, port: int, host: str, open_browser: bool, block: bool = True, limits: Limits | None = None
) -> Window:
    """As `view`, of a session."""
    window = Window(session, port, host, limits)
    print(f"rodjax: the window is at {window.url}" + ("; Ctrl-C closes it" if block else ""), flush=True)
    if open_browser:
        window.open()
    if block:
        window.wait()
    return window


def session_of(
    shown: Scene | Harness | Equilibrium | HarnessEquilibrium,
    segments: int | None,
    strain_limit: float = DEFAULT_STRAIN_LIMIT,
) -> Session:
    """A session that begins with what is shown."""
    if isinstance(shown, Scene | Harness):
        return Session(shown, segments=SEGMENTS if segments is None else segments, strain_limit=strain_limit)
    axes = shown.status.ndim
    if axes > 1:
        raise ValueError(f"shown must have one leading axis at most, got {shown.status.shape}")
    if isinstance(shown, Equilibrium) and shown.discretization == "continuum":
        raise ValueError("shown must be of elements or finite differences, got one of the continuum")
    last = jax.tree.map(lambda leaf: leaf[-1], shown) if axes else shown
    if segments is None:
        meshes = [last.s.shape[-1] - 1] if isinstance(last, Equilibrium) else last.segments
        segments = max(meshes)
    session = Session(scene_in(last), segments=segments, guess=last, strain_limit=strain_limit)
    if axes:
        session.add_recorded(shown)
    return session
