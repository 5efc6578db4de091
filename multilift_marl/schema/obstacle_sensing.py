"""What drones observe of obstacles: section `env.obstacles`, used by `env.obstacle_sensing`."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from multilift_marl.schema.values import Between, Float, Int, Section


class ObstacleSensingConfig(Section):
    """The sensors of obstacles that each drone carries; of `map` only `points` counts."""

    points: Int = Field(3, ge=1, le=50, description="with map, local: nearest points, each of another obstacle")
    range: Annotated[Float, Between(0.01, 1000, "m")] = Field(5.0, description="[m] of the sensor")
    beams: Int = Field(16, ge=1, le=360, description="with ranges: beams of the ring, the first along the heading")
    field_of_view: Annotated[Float, Between(1, 360, "deg")] = Field(
        360.0, description="[deg] with local: horizontal, about the heading"
    )
    rate: Annotated[Float | None, Between(0.01, 1e5, "Hz")] = Field(
        None, description="[Hz] of its measurements, into which env.policy_hz divides; None: each policy step"
    )
    delay: Int = Field(0, ge=0, le=100, description="[policy steps] until a measurement is observed")
    noise: Annotated[Float, Between(0, 10, "m")] = Field(
        0.0, ge=0, description="[m] standard deviation, of each coordinate or range, drawn for each measurement"
    )
