"""Baselines, with the interface of learned policies, and the base policies that learned ones correct."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from multilift_marl.errors import ConfigError, nearest
from multilift_marl.policies.adaptive import FormationAdaptive
from multilift_marl.policies.balanced import FormationBalanced
from multilift_marl.policies.filing import FormationFiled
from multilift_marl.policies.formation import (
    Formation,
    FormationFeedback,
    FormationGusts,
    FormationIntegral,
    FormationLead,
    FormationNarrow,
    FormationRedistributed,
)
from multilift_marl.policies.hold import (
    HoldAcceleration,
    HoldAccRates,
    HoldCtbm,
    HoldCtbr,
    HoldFullState,
    HoldRotor,
    HoldVelocity,
)
from multilift_marl.policies.mpc import TeamMpc
from multilift_marl.policies.mpc_distributed import DistributedMpc, DistributedRouteMpc
from multilift_marl.policies.payload_geometric import PayloadGeometric
from multilift_marl.policies.policy import OwnPolicy, Policy
from multilift_marl.policies.repelled import FormationRepelled
from multilift_marl.policies.route_baselines import NarrowRouteMpc, PayloadRouteMpc, PotentialRouteMpc
from multilift_marl.policies.route_formation import RouteFormation
from multilift_marl.policies.route_mpc import RouteMpc
from multilift_marl.policies.tuned import tuned_policy
from multilift_marl.schema.training import TUNED

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
    "hold_full_state": HoldFullState,
    "hold_ctbr": HoldCtbr,
    "hold_ctbm": HoldCtbm,
    "hold_rotor": HoldRotor,
}
"""Baselines that are linear maps of the observation."""
Script = (
    type[Formation]
    | type[PayloadGeometric]
    | type[TeamMpc]
    | type[RouteFormation]
    | type[FormationRepelled]
    | type[FormationFiled]
    | type[FormationAdaptive]
    | type[FormationBalanced]
)
SCRIPTED: dict[str, Script] = {
    **LINEAR,
    "mpc": TeamMpc,
    "mpc_distributed": DistributedMpc,
    "mpc_route": RouteMpc,
    "mpc_route_distributed": DistributedRouteMpc,
    "formation_route": RouteFormation,
    "formation_repelled": FormationRepelled,
    "formation_filed": FormationFiled,
    "formation_adaptive": FormationAdaptive,
    "formation_balanced": FormationBalanced,
    "mpc_payload": PayloadRouteMpc,
    "mpc_narrow": NarrowRouteMpc,
    "mpc_potential": PotentialRouteMpc,
    "payload_geometric": PayloadGeometric,
}
_OTHERWISE = {
    "": ", or leave the baseline out (baseline=none, train.residual=formation)",
    "policy": ", or take another policy",
    "baseline": ", or leave it out by baseline=none",
    "train.residual": ", or take train.residual=formation, which is zero by all of them",
}
"""What else cures a baseline of another interface, by the key that names it."""


def _by_name(name: str) -> Script:
    """Return the class of a baseline or of tuned gains; of a name that both have, the baseline."""
    return SCRIPTED[name] if name in SCRIPTED else tuned_policy(name)


def fitting_scripts(vec: MultiliftVec) -> list[str]:
    """Return the names of baselines that can act in environments, but for those that plan or know the truth."""
    fitting = []
    for name, script in SCRIPTED.items():
        if issubclass(script, TeamMpc | RouteFormation | FormationBalanced):
            continue
        if issubclass(script, FormationRepelled | FormationFiled | FormationAdaptive):
            known = script.sees(vec)
        else:
            known = not script.refusal(vec) if issubclass(script, Formation) else vec.config.env.sensing == "ideal"
        if known and script.INTERFACE == vec.config.control.action:
            fitting.append(name)
    return fitting


def make_scripted(name: str, vec: MultiliftVec) -> Policy:
    """Return the baseline `name`, tuned gains, or one's own class module:Class, for the environments `vec`.

    Raises:
        ConfigError: there is no such baseline, or the environments have another action interface than it acts by, or do
            not observe what it needs; or see `OwnPolicy`.
    """
    if ":" in name:
        return OwnPolicy(name, vec)
    known = (*TUNED, *SCRIPTED)
    if name not in known:
        raise ConfigError(f"unknown baseline '{name}'{nearest(name, known)}")
    check_interface(name, vec.config.control.action)
    if name == "payload_geometric" and (level := vec.config.env.sensing) != "ideal":
        raise ConfigError(
            f"payload_geometric reads the true state; set env.sensing=ideal, not {level}, or leave it out"
        )
    return _by_name(name)(vec)


def check_interface(name: str, action: str, role: str = "") -> None:
    """Refuse the baseline `name` with an action interface that it does not act by, by a ConfigError.

    Args:
        name: of a baseline or of tuned gains; others are known only where they are made.
        action: `control.action`.
        role: the key that names it, for the cure: policy, baseline or train.residual.
    """
    if name not in (*TUNED, *SCRIPTED) or (role == "train.residual" and name == "formation"):
        return
    policy = _by_name(name)
    known = policy.INTERFACE
    if action not in getattr(policy, "INTERFACES", (known,)):
        holds = [other for other, script in SCRIPTED.items() if script.INTERFACE == action and action != "reference"]
        fits = f"take {f'{role}=' if role else ''}{holds[0]}, set" if holds else "set"
        raise ConfigError(
            f"the baseline '{name}' acts by control.action={known} and cannot fly control.action={action}; "
            f"{fits} control.action={known}{_OTHERWISE[role]}"
        )


def make_base_policy(name: str, vec: MultiliftVec) -> Policy:
    """Return what `train.residual` names, as a policy; `formation` acts by zeros with every interface."""
    return LINEAR[name](vec) if name == "formation" else make_scripted(name, vec)


def base_matrix(name: str, vec: MultiliftVec) -> np.ndarray:
    """Return M (A, D) of the base policy that a learned one corrects; `formation` is zero with every interface.

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
