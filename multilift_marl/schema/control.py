"""Parameters of the drones' controller and its action interface, section `control`."""

from __future__ import annotations

from math import pi
from typing import Annotated, Literal

from pydantic import Field

from multilift_marl.schema.values import Between, Float, Section


class ControlConfig(Section):
    """The drones' geometric controller and its action interface."""

    action: Literal[
        "reference", "velocity", "acceleration", "acc_rates", "full_state", "planner_weights", "ctbr", "ctbm", "rotor"
    ] = Field("reference", description="what an action means (docs/control.md)")
    heading: Literal["target", "outward"] = Field(
        "target", description="drones face where the target does, or away from the payload, each through its slot"
    )
    max_offset: Annotated[Float, Between(0, 100, "m")] = Field(
        0.5, gt=0, description="[m] slot offset of a full action of `reference`, `full_state`, along each axis"
    )
    max_yaw: Annotated[Float, Between(0, pi, "rad")] = Field(0.5, gt=0, description="[rad] yaw offset of a full action")
    max_velocity: Annotated[Float, Between(0, 50, "m/s")] = Field(
        1.0, gt=0, description="[m/s] of a full action of `velocity`, `full_state`, along each axis"
    )
    max_acceleration: Annotated[Float, Between(0, 1000, "m/s²")] = Field(
        3.0, gt=0, description="[m/s²] of a full action of `acceleration`, `acc_rates`, `full_state`"
    )
    max_jerk: Annotated[Float, Between(0, 1e5, "m/s³")] = Field(
        30.0, gt=0, description="[m/s³] of a full action of `full_state`, along each axis"
    )
    max_cable_force: Annotated[Float, Between(0, 100)] = Field(
        0.5, gt=0, description="[-] over the nominal force, of a full action of `full_state`, along each axis"
    )
    max_tilt_rate: Annotated[Float, Between(0, 100, "rad/s")] = Field(
        4.0, gt=0, description="[rad/s] roll, pitch of a full action of `acc_rates`, `ctbr`"
    )
    max_yaw_rate: Annotated[Float, Between(0, 100, "rad/s")] = Field(
        1.5, gt=0, description="[rad/s] of a full action of `velocity`, `acceleration`, `ctbr`"
    )
    max_angular_acceleration: Annotated[Float, Between(0, 1e4, "rad/s²")] = Field(
        200.0, gt=0, description="[rad/s²] of a full action of `ctbm`, about each axis"
    )
    max_weight: Annotated[Float, Between(1, 1e6)] = Field(
        100.0, gt=1, description="[-] factor of a planner's weight of a full action of `planner_weights`"
    )
    reference_frequency: Annotated[Float, Between(0.01, 1e4, "rad/s")] = Field(
        6.0, gt=0, description="[rad/s] bandwidth of the smoothed reference"
    )
    reference_speed: Annotated[Float, Between(1e-3, 50, "m/s")] = Field(
        1.0, gt=0, description="[m/s] speed limit of the smoothed reference"
    )
    obstacle_margin: Annotated[Float, Between(0, 10, "m")] = Field(
        0.0, description="[m] that set-points of `reference` keep from obstacles the drone sees; 0: none"
    )
    payload_margin: Annotated[Float, Between(0, 10, "m")] = Field(
        0.0, description="[m] that they keep the payload from these, where it moves as they do; 0: none"
    )
    sector_margin: Annotated[Float, Between(0, 10, "m")] = Field(
        0.0, description="[m] that they keep from the planes halfway to the neighbours' slots; 0: none"
    )
    swing_shift: Annotated[Float, Between(0, 10, "m/rad")] = Field(
        0.0,
        description="[m/rad] that those of two drones move aside against the swing of their payload; 0: none",
    )
    position_frequency: Annotated[Float | None, Between(0.01, 1000, "rad/s")] = Field(
        4.0, gt=0, description="[rad/s] of the position loop; at most 1/5 of attitude's; None: that"
    )
    position_damping: Annotated[Float, Between(0.01, 100)] = Field(1.0, gt=0, description="[-] its damping ratio")
    attitude_frequency: Annotated[Float | None, Between(0.01, 1e4, "rad/s")] = Field(
        20.0, gt=0, description="[rad/s] of roll and pitch; at most 0.7/motor lag; None: that"
    )
    attitude_damping: Annotated[Float, Between(0.01, 100)] = Field(0.8, gt=0, description="[-] its damping ratio")
    drag_feedforward: bool = Field(False, description="feed the drones' nominal drag in still air forward")
    yaw_frequency: Annotated[Float, Between(0.01, 1e4, "rad/s")] = Field(
        8.0, gt=0, description="[rad/s] natural frequency of yaw"
    )
    disturbance: Literal["none", "integral", "indi"] = Field(
        "none", description="rejection of unknown forces on a drone (docs/control.md)"
    )
    disturbance_frequency: Annotated[Float, Between(0.01, 1000, "rad/s")] = Field(
        3.0, gt=0, description="[rad/s] bandwidth of that rejection; less where the load asks for it (docs/control.md)"
    )
    disturbance_limit: Annotated[Float, Between(1e-3, 100)] = Field(
        0.5, gt=0, description="[-] largest force rejected, in weights of the drone"
    )
