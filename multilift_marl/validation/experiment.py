"""What an experiment returns, and the list of all of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np


class Row(NamedTuple):
    """One comparison with theory; `error` and `limit` have the same unit, given in `quantity`."""

    experiment: str
    quantity: str
    theory: float
    simulated: float
    error: float
    limit: float

    @property
    def passed(self) -> bool:
        """Whether the error is within its limit; False for NaN."""
        return bool(self.error <= self.limit)

    def as_dict(self) -> dict:
        """Return the row as it stands in validation.json."""
        return {**self._asdict(), "pass": self.passed}


@dataclass
class Curve:
    """One line of a plot."""

    label: str
    x: np.ndarray
    y: np.ndarray
    theory: bool = False


@dataclass
class Plot:
    """One picture: curves over a common axis."""

    name: str
    title: str
    x_label: str
    y_label: str
    curves: list[Curve] = field(default_factory=list)
    equal: bool = False
    """Whether both axes have the same scale."""
    log: bool = False
    """Whether both axes are logarithmic."""


@dataclass
class Result:
    """What an experiment found."""

    rows: list[Row] = field(default_factory=list)
    plots: list[Plot] = field(default_factory=list)


Experiment = Callable[[bool], Result]
"""Runs an experiment; the argument asks for a fast, coarser version."""


def relative(simulated: float, theory: float) -> float:
    """Return |simulated - theory| / |theory|."""
    return abs(simulated - theory) / abs(theory)
