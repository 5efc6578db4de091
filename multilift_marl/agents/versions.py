"""Versions of the packages that a result depends on."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, version

_PACKAGES = ("multilift_marl", "numpy", "mujoco", "numba", "torch", "torchrl", "tensordict", "gymnasium", "pettingzoo")


def package_versions(*more: str) -> dict[str, str | None]:
    """Return the version of each package that training depends on, and of `more`; None for one not installed."""
    return {name: _version(name) for name in (*_PACKAGES, *more)}


def _version(name: str) -> str | None:
    try:
        return version(name)
    except PackageNotFoundError:
        return None
