"""What the policy node cannot fly."""

from __future__ import annotations

from multilift_marl.config.config import Config
from multilift_marl.deploy.ros.messages import NAMES, POSE
from multilift_marl.errors import ConfigError

PX4 = "px4"  # a receiver of set-points


def check_flyable(config: Config, names: str = "multilift", receiver: str = PX4) -> None:
    """Refuse, by a ConfigError, what the node cannot fly."""
    able = ("reference",) if NAMES[names].setpoints == POSE else ("reference", "full_state")
    if config.control.action not in able:
        raise ConfigError(
            f"set-points of names={names} are those of control.action={' or '.join(able)}, not of "
            f"{config.control.action}; take a policy of that"
        )
    if receiver != PX4 and not NAMES[names].is_report:
        raise ConfigError(f"receiver={receiver} takes set-points of PX4; set names=report")
    if config.env.sensing == "onboard":
        raise ConfigError("this node cannot fly policies of env.sensing=onboard: nobody measures the cables' tension")
    if (task := config.task) in ("loss", "regroup"):
        what = "whose motors have stopped" if task == "loss" else "whose cables are attached"
        raise ConfigError(f"this node cannot fly config={task}: nobody measures {what}")
