"""Files that are there whole or not at all, and folders for them."""

from __future__ import annotations

import itertools
import os
import tempfile
import threading
from collections.abc import Mapping
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
    write_together({path: content}, flush)


def write_together(contents: Mapping[Path, bytes | memoryview], flush: bool = True) -> None:
    """Do as `write_whole` with files of which none is renamed before all are written; they are in this order."""
    asides = {path: name_aside(path) for path in contents}
    try:
        for path, content in contents.items():
            with open(asides[path], "wb") as file:
                file.write(content)
                if flush:
                    file.flush()
                    os.fsync(file.fileno())
        for path, aside in asides.items():
            os.replace(aside, path)
    except BaseException:
        for aside in asides.values():
            with suppress(OSError):
                aside.unlink(missing_ok=True)
        raise


def name_aside(path: Path, suffix: str = ".tmp") -> Path:
    """Return where to write what is renamed to `path` when it is whole: a name of no other writer.

    In the same folder, for a rename replaces a file at once within one file system only.
    """
    return path.with_name(f"{path.name}-{os.getpid()}-{threading.get_ident()}{suffix}")


def check_writable(folder: Path) -> None:
    """Find out, before long work, whether a folder can be written to, or made where there is none; make nothing.

    Raises:
        OSError, ValueError: it cannot.
    """
    place = folder.absolute()
    while not os.path.lexists(place) and place != place.parent:
        place = place.parent
    tempfile.TemporaryFile(dir=place).close()


def make_run_folder(runs: Path, stem: str) -> Path:
    """Return a new folder of this name, or of the next one that is free; no other process has it."""
    for again in itertools.count(1):
        folder = runs / (stem if again == 1 else f"{stem}-{again}")
        with suppress(FileExistsError):
            folder.mkdir()
            break
    return folder
