"""What an experiment returns: rows that compare with theory, and pictures."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

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

    def as_dict(self) -> dict[str, Any]:
        """Return the row as it stands in validation.json; what is not finite is None."""
        numbers = {key: float(getattr(self, key)) for key in ("theory", "simulated", "error", "limit")}
        finite = {key: value if np.isfinite(value) else None for key, value in numbers.items()}
        return {"experiment": self.experiment, "quantity": self.quantity, **finite, "pass": self.passed}


@dataclass
class Curve:
    """One line of a plot; without a label it is left out of the legend."""

    label: str
    x: np.ndarray
    y: np.ndarray
    theory: bool = False


@dataclass
class Plot:
    """One picture: curves over a common axis, and more below it if asked for."""

    name: str
    title: str
    x_label: str
    y_label: str
    curves: list[Curve] = field(default_factory=list)
    equal: bool = False
    """Whether both axes have the same scale."""
    caption: str = ""
    """One line for the document; the title if empty."""
    phases: list[tuple[str, float, float]] = field(default_factory=list)
    """Name, start and end of spans of x that are told apart by shade."""
    log: bool = False
    """Whether both axes are logarithmic."""
    semilog: bool = False
    """Whether the y axis is."""
    below: Plot | None = None
    """A second panel over the same x."""


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


def order_row(
    experiment: str, quantity: str, errors: Sequence[float], steps: Sequence[float], least: float = 0.9
) -> Row:
    """Return the row that asks that `errors` vanish with the time `steps` [s], at least with a power `least`."""
    order = float(np.log(errors[0] / errors[-1]) / np.log(steps[0] / steps[-1]))
    words = f"{quantity}: order in the time step, {ms(steps[0])} to {ms(steps[-1])}, shortfall of {least:g}"
    return Row(experiment, words, 1.0, order, max(0.0, least - order), 0.0)


def ms(seconds: float) -> str:
    """Return a time step in words."""
    return f"{1e3 * seconds:g} ms"
