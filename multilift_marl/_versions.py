"""What results depend on beside configuration and seed: versions, and this package's own sources."""

from __future__ import annotations

import hashlib
from functools import cache
from pathlib import Path

import mujoco

import multilift_marl as ml

_PACKAGE = Path(__file__).parent


def find_versions() -> dict[str, str]:
    """Return the versions of this package and of MuJoCo, and a digest of this package's sources."""
    return {"multilift_marl": ml.__version__, "sources": digest_sources(), "mujoco": mujoco.__version__}


@cache
def digest_sources(package: Path = _PACKAGE) -> str:
    """Return a digest of a package's code and gains, the same for a checkout and what is installed of it."""
    digest = hashlib.sha256()
    for path in sorted(each for each in package.rglob("*") if each.suffix in (".py", ".yaml")):
        name = path.relative_to(package).as_posix()
        if not name.startswith("configs/"):  # beside the package in a checkout; their values are known by themselves
            # Git may have changed line ends.
            digest.update(name.encode() + b"\0" + path.read_bytes().replace(b"\r\n", b"\n"))
    return digest.hexdigest()[:16]
