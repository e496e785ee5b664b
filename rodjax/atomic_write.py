"""replace_file(): a file is written as a whole or not at all; seal(): whether it still is what was written.

HDF5 files stay readable for all programs with a seal after their end. One that changes such a file in place drops it,
and ends the file where its superblock says that it ends (HDF5 File Format Specification, version 3.0, II.A).
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

SIGNATURE = b"\x89HDF\r\n\x1a\n"
# Of the file's end in the superblock, eight bytes as h5py writes it, by its version.
END_OFFSETS = {0: 40, 1: 44, 2: 28, 3: 28}


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
    """Whether an HDF5 file is sealed. Raises `ValueError` where it is not what was sealed, or where what follows its
    end is no seal: then one was damaged, and the content perhaps with it.
    """
    size = file.seek(0, os.SEEK_END)
    if size < SEAL_SIZE:
        return False
    file.seek(size - SEAL_SIZE)
    mark, digest = file.read(len(MARK)), file.read()
    if mark == MARK:
        if digest != _digest(file, size - SEAL_SIZE):
            raise ValueError("it is damaged: its content is not what was written")
        return True
    end = _end(file)
    if end is not None and end < size:
        raise ValueError(f"it is damaged: the seal after its end is missing ({size - end} bytes of something else)")
    return False


def _end(file: BinaryIO) -> int | None:
    """Where HDF5's part of a file ends, in bytes; `None` where it does not begin as an HDF5 file."""
    file.seek(0)
    head = file.read(64)
    offset = END_OFFSETS.get(head[8]) if head.startswith(SIGNATURE) and len(head) == 64 else None
    return None if offset is None else int.from_bytes(head[offset : offset + 8], "little")


def _digest(file: BinaryIO, size: int) -> bytes:
    """Of the first `size` bytes."""
    digest = hashlib.sha256()
    file.seek(0)
    for begin in range(0, size, BLOCK):
        digest.update(file.read(min(BLOCK, size - begin)))
    file.seek(size)
    return digest.digest()
