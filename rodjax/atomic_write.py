"""replace_file(): a file is written as a whole or not at all."""

import os
import uuid
from contextlib import suppress
from pathlib import Path


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
