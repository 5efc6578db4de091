"""Scripted teams, with the interface of learned policies: the baselines, and what learned ones start from."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from multilift_marl.control.payload_geometric import PayloadGeometric
from multilift_marl.control.policy import OwnPolicy, Policy
from multilift_marl.control.scripted_formation import (
    Formation,
    FormationFeedback,
    FormationGusts,
    FormationIntegral,
    FormationLead,
    FormationNarrow,
    FormationRedistributed,
)
from multilift_marl.control.scripted_hold import (
    HoldAcceleration,
    HoldAccRates,
    HoldCtbm,
    HoldCtbr,
    HoldRotor,
    HoldVelocity,
)
from multilift_marl.errors import ConfigError, nearest

if TYPE_CHECKING:
    from multilift_marl.envs.core import MultiliftVec

LINEAR: dict[str, type[Formation]] = {
    "formation": Formation,
    "formation_integral": FormationIntegral,
    "formation_feedback": FormationFeedback,
    "formation_gusts": FormationGusts,
    "formation_lead": FormationLead,
    "formation_narrow": FormationNarrow,
    "formation_redistributed": FormationRedistributed,
    "hold_velocity": HoldVelocity,
    "hold_acceleration": HoldAcceleration,
    "hold_acc_rates": HoldAccRates,
    "hold_ctbr": HoldCtbr,
    "hold_ctbm": HoldCtbm,
    "hold_rotor": HoldRotor,
}
"""Scripts that are maps of the observation."""
SCRIPTED: dict[str, type[Formation] | type[PayloadGeometric]] = {
    **LINEAR,
    "payload_geometric": PayloadGeometric,
}


def fitting_scripts(vec: MultiliftVec) -> list[str]:
    """Return the names of the scripts that can act in the environments `vec`."""
    fitting = []
    for name, script in SCRIPTED.items():
        known = not script.refusal(vec) if issubclass(script, Formation) else vec.config.env.sensing == "ideal"
        if known and script.INTERFACE == vec.config.control.action:
            fitting.append(name)
    return fitting


def make_scripted(name: str, vec: MultiliftVec) -> Policy:
    """Return the scripted policy `name`, or that of one's own class module:Class, for the environments `vec`.

    Raises:
        ConfigError: there is no such script, or the environments have another action interface than it acts by, or do
            not observe what it needs; or see `OwnPolicy`.
    """
    if ":" in name:
        return OwnPolicy(name, vec)
    if name not in SCRIPTED:
        raise ConfigError(f"unknown scripted policy '{name}'{nearest(name, SCRIPTED)}")
    check_interface(name, vec.config.control.action)
    if name == "payload_geometric" and (level := vec.config.env.sensing) != "ideal":
        raise ConfigError(
            f"payload_geometric reads the true state; set env.sensing=ideal, not {level}, or leave it out"
        )
    return SCRIPTED[name](vec)


def check_interface(name: str, action: str) -> None:
    """Refuse the script `name` with an action interface that it does not act by, by a ConfigError."""
    known = SCRIPTED[name].INTERFACE
    if action != known:
        holds = [other for other, script in SCRIPTED.items() if script.INTERFACE == action and action != "reference"]
        fits = f"take {holds[0]}, set" if holds else "set"
        raise ConfigError(
            f"the scripted policy '{name}' acts by control.action={known} and cannot fly control.action={action}; "
            f"{fits} control.action={known}, or leave the script out (baseline=none, train.residual=formation)"
        )


def make_residual(name: str, vec: MultiliftVec) -> Policy:
    """Return what `train.residual` names, as a policy; `formation` acts by zeros with every interface."""
    return LINEAR[name](vec) if name == "formation" else make_scripted(name, vec)


def residual_matrix(name: str, vec: MultiliftVec) -> np.ndarray:
    """Return M (A, D) of the script that a learned policy corrects; `formation` is zero with every interface.

    Raises:
        ConfigError: see `make_scripted`; or one's own class has no `matrix()` that returns such a one.
    """
    shape = vec.action_size, vec.observation_size
    if name == "formation":
        return np.zeros(shape, np.float32)
    policy = OwnPolicy(name, vec, "train.residual").policy if ":" in name else make_scripted(name, vec)
    matrix = policy.matrix() if hasattr(policy, "matrix") else None
    if not isinstance(matrix, np.ndarray) or matrix.shape != shape or not np.isfinite(matrix).all():
        raise ConfigError(
            f"train.residual={name} needs a method matrix() that returns finite numbers {shape} (numbers of an action, "
            "of an observation)"
        )
    return matrix.astype(np.float32)
