"""Numba's compiler as this package uses it: no fast-math, no GIL, results kept on disk."""

from __future__ import annotations

import hashlib
from pathlib import Path

from numba import njit

kernel = njit(cache=True, nogil=True, error_model="numpy")
"""Compiles a function to machine code at its first call. Arithmetic is exact IEEE, so results do not depend on how
many environments are computed together."""


def _drop_stale_kernels() -> None:
    """Delete compiled kernels when any source of the package has changed.

    Numba looks only at the file of the kernel itself, not at the files of the functions that it calls.
    """
    package = Path(__file__).parent
    digest = hashlib.sha256()
    for source in sorted(package.rglob("*.py")):
        digest.update(source.read_bytes())
    stamp = package / "__pycache__" / "kernels.sha256"
    try:
        if stamp.is_file() and stamp.read_text() == digest.hexdigest():
            return
        for index in package.rglob("__pycache__/*.nbi"):
            index.unlink(missing_ok=True)
        stamp.parent.mkdir(exist_ok=True)
        stamp.write_text(digest.hexdigest())
    except OSError:  # installed read-only: Numba then keeps its cache in the user's own folder
        return


_drop_stale_kernels()
