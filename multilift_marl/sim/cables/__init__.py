"""Cable models by name: modules with the same functions, those of `CableModel`.

A model of one's own is a module here, a line in `CABLE_MODELS` and its name in `schema/sections.py`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import mujoco
import numpy as np
from mujoco.batch import Batch

from multilift_marl.rig.system import System
from multilift_marl.sim.cables import chain, massless
from multilift_marl.sim.parameters import Inertias, Parameters
from multilift_marl.sim.state import SimData
from multilift_marl.sim.state_io import Rows


class CableModel(Protocol):
    """The functions of a cable model.

    `cables` is what its `make_cables` returns: a named tuple for compiled functions. Its field `nodes` is the model's
    own state, a named tuple of arrays, environment first, or None.
    """

    SLACK: float
    """Distance of its ends over its length below which a cable starts slack [-]."""

    def add_cable(self, spec: mujoco.MjSpec, system: System, index: int) -> None:
        """Add a cable to a specification that holds payload and drone, where MuJoCo simulates it."""

    def set_constants(self, model: mujoco.MjModel, system: System) -> None:
        """Set constants of the compiled model that depend on its masses."""

    def make_cables(self, system: System, parameters: Parameters, inertias: Inertias) -> Any:
        """Return the cables of all environments, which refer to parameters and inertias."""

    def update_cables(self, cables: Any, system: System, parameters: Parameters) -> None:
        """Bring cables into line with parameters that have changed."""

    def update_models(
        self, batch: Batch, system: System, parameters: Parameters, mask: np.ndarray, names: set[str],
        broken: np.ndarray,
    ) -> None:  # fmt: skip
        """Bring MuJoCo's models into line with parameters that have changed.

        Args:
            batch: of n simulations.
            system: common to them.
            parameters: of these n.
            mask: (n,) bool, those with new parameters.
            names: the new parameters, and "cable_broken" where that has changed.
            broken: (n, N) bool, broken cables.
        """

    def bind_steps(
        self, batch: Batch, rows: Rows, data: SimData, cables: Any
    ) -> tuple[Callable[[], None], Callable[[], None]]:
        """Return what to call before MuJoCo's step of a batch, and what reads the state after it."""

    def write_state(self, rows: Rows, mask: np.ndarray, data: SimData, cables: Any) -> None:
        """Write the state of the environments in `mask` (E,) into rows, and start their statistics anew."""


CABLE_MODELS: dict[str, CableModel] = {
    "massless": massless,
    "chain": chain,
}
