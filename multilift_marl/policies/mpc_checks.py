"""What model-predictive control cannot fly, and what it is warned of."""

from __future__ import annotations

from typing import TYPE_CHECKING

from multilift_marl.errors import ConfigError
from multilift_marl.planning.team_model import has_model, warn_of_heavy_cables, warn_of_slow_motors

if TYPE_CHECKING:
    from multilift_marl.envs.core import MultiliftVec


def check_team(vec: MultiliftVec, asked: str) -> None:
    """Refuse, by a ConfigError, environments that no plan is for; see `TeamMpc`.

    Args:
        vec: the environments.
        asked: key=value by which plans are asked for.
    """
    system, config = vec.world.system, vec.config
    other = f"another {asked.partition('=')[0]}"
    if not vec.task.CAN_PLAN:
        raise ConfigError(
            f"{asked} cannot fly task {config.task}: it plans for taut cables, all drones and free air; take {other}"
        )
    if not has_model(system):
        raise ConfigError(
            f"{asked} plans for bodies with two anchors or more, apart, and for points; set payload.shape=point, or "
            f"take {other} for this rig"
        )
    rejection = config.control.disturbance
    if config.planner.estimate and rejection != "none":
        raise ConfigError(
            f"{asked} estimates unknown forces, which control.disturbance={rejection} would reject a second time; set "
            "control.disturbance=none, or planner.estimate=false"
        )
    warn_of_heavy_cables(system, asked)
    warn_of_slow_motors(system, asked)
