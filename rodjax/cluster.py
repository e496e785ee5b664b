"""connected(): the workers of a Dask scheduler as an executor, for the command line."""

import logging
from collections.abc import Callable, Iterator
from concurrent.futures import Executor
from contextlib import contextmanager

# Seconds to wait for a scheduler to answer.
TIMEOUT = 10.0


class ClusterError(ValueError):
    """What the user can mend; the message is one line."""


@contextmanager
def connected(address: str | None, say: Callable[[str], None]) -> Iterator[Executor | None]:
    """The executor of the scheduler at `address`, such as tcp://host:8786; `None` for none.

    `say` gets a line where the scheduler has no workers yet. Raises `ClusterError` where Dask is not installed, the
    address is none, or no scheduler answers.
    """
    if address is None:
        yield None
        return
    try:
        from distributed import Client
    except ImportError as error:
        raise ClusterError(
            f"--scheduler needs Dask, which is not installed ({error}): pip install 'rodjax[cluster]'"
        ) from None
    # Lost connections are told by the command in its own way.
    for name in [name for name in logging.root.manager.loggerDict if name.split(".")[0] in ("distributed", "tornado")]:
        logging.getLogger(name).setLevel(logging.CRITICAL)
    try:
        client = Client(address, timeout=TIMEOUT, set_as_default=False)
    except (OSError, ValueError) as error:  # OSError: TimeoutError too
        reason = " ".join(str(error).split())
        raise ClusterError(
            f"--scheduler must be the address of a Dask scheduler, such as tcp://host:8786; none answers at {address}: "
            f"{reason}"
        ) from None
    with client:
        if not client.nthreads():
            say(f"the scheduler at {address} has no workers yet: waiting for them")
        yield client.get_executor(pure=False)
