"""locked(): one process at a time works on a file."""

import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

try:
    import fcntl
except ImportError:  # Windows: nothing is locked
    fcntl = None


class LockedError(OSError):
    """Another process works on the file; the message is one line."""


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """Holds a lock for `path`, in a file `<path>.lock` beside it, which ends with this process, however that ends.

    Raises `LockedError` where another process holds it, `OSError` where the folder cannot be written to.
    """
    lock = path.with_name(f"{path.name}.lock")
    file = _locked_file(lock, path)
    try:
        os.ftruncate(file, 0)
        os.write(file, f"process {os.getpid()} on {socket.gethostname()}".encode())
        yield
    finally:
        with suppress(OSError):
            lock.unlink()
        os.close(file)


def _locked_file(lock: Path, path: Path) -> int:
    while True:
        file = os.open(lock, os.O_RDWR | os.O_CREAT, 0o666)
        try:
            if fcntl is not None:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            # The one who held it may have taken the file away since.
            if os.path.samestat(os.fstat(file), os.stat(lock)):
                return file
        except FileNotFoundError:
            pass
        except BlockingIOError:
            other = os.read(file, 200).decode(errors="replace") or "another process"
            os.close(file)
            raise LockedError(f"{path} is being written by {other}; wait for it, or stop it") from None
        except BaseException:
            os.close(file)
            raise
        os.close(file)
