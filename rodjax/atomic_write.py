"""replace_file(): a file is written as a whole or not at all; seal(): whether it still is what was written.

HDF5 files stay readable for all programs with a seal after their end. One that changes such a file in place drops it.
"""

import hashlib
import os
import uuid
from contextlib import suppress
from pathlib import Path
from typing import BinaryIO

MARK = b"\nsha256 "
SEAL_SIZE = len(MARK) + hashlib.sha256().digest_size
BLOCK = 2**20


def replace_file(path: Path, content: bytes) -> None:
    """Puts a new file in the place of `path` in one step; a kill before it may leave a hidden `.tmp` file behind.

    Raises `OSError` with the names of the file and its folder where it cannot be written.
    """
    temporary = path.with_name(f".rodjax-{uuid.uuid4().hex}.tmp")
    try:
        with open(temporary, "xb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except OSError as error:
        reason = f"cannot write {path.name}: {error.strerror}; folder"
        raise OSError(error.errno, reason, str(path.parent)) from error
    finally:
        with suppress(OSError):
            temporary.unlink()


def seal(file: BinaryIO) -> None:
    """Adds a hash of all that is in a file to its end."""
    digest = _digest(file, file.seek(0, os.SEEK_END))
    file.write(MARK + digest)


def has_seal(file: BinaryIO) -> bool:
    """Whether a file is sealed. Raises `ValueError` where it is not what was sealed."""
    size = file.seek(0, os.SEEK_END) - SEAL_SIZE
    if size < 0:
        return False
    file.seek(size)
    mark, digest = file.read(len(MARK)), file.read()
    if mark != MARK:
        return False
    if digest != _digest(file, size):
        raise ValueError("it is damaged: its content is not what was written")
    return True


def _digest(file: BinaryIO, size: int) -> bytes:
    """Of the first `size` bytes."""
    digest = hashlib.sha256()
    file.seek(0)
    for begin in range(0, size, BLOCK):
        digest.update(file.read(min(BLOCK, size - begin)))
    file.seek(size)
    return digest.digest()
