"""Files that are there whole or not at all."""

from __future__ import annotations

import os
import threading
from contextlib import suppress
from pathlib import Path


def write_whole(path: Path, content: bytes | memoryview, flush: bool = True) -> None:
    """Write a file aside and rename it, so that neither a full disk nor a killed process costs what was there.

    Other processes may write the same file: that of the last one stays.

    Args:
        path: the file; its folder is there.
        content: of the file.
        flush: whether it must be on the disk when this returns, and so outlive the machine.

    Raises:
        OSError: it cannot be written.
    """
    aside = path.with_name(f"{path.stem}-{os.getpid()}-{threading.get_ident()}.tmp")  # no other writer's
    try:
        with open(aside, "wb") as file:
            file.write(content)
            if flush:
                file.flush()
                os.fsync(file.fileno())
        os.replace(aside, path)
    except BaseException:
        with suppress(OSError):
            aside.unlink(missing_ok=True)
        raise
