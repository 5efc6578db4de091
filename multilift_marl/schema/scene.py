"""What stands or moves in the scene of any configuration: section `scene`."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BeforeValidator, Field

from multilift_marl.schema.files import pin_text
from multilift_marl.schema.values import Between, Float, Int, Positive, Section, Vector

NotNegative = Annotated[Float, Field(ge=0)]


def _gap(value: Any) -> Any:
    """Refuse a list of another length than the two that there are, of which pydantic's message would name one."""
    if not isinstance(value, list | tuple) or len(value) not in (2, 4):
        raise ValueError("must be a list of 2 or 4 numbers")
    return value


Gap = Annotated[tuple[Float, Positive] | tuple[Float, Positive, NotNegative, Positive], BeforeValidator(_gap)]


class ObstacleConfig(Section):
    """One obstacle: a rigid convex body that nothing moves; a wall is several, a mesh its convex hull."""

    shape: Literal["box", "cylinder", "sphere", "wall", "mesh"] = Field(
        "box", description="upright as given by its size"
    )
    size: Annotated[tuple[Positive, ...] | None, Between(1e-3, 1000, "m")] = Field(
        None,
        description="[m] box, wall: edges along x, y, z; cylinder: diameter, height; sphere: diameter; mesh: edges of "
        "its bounding box, None as in the file",
    )
    position: Annotated[Vector, Between(-1e4, 1e4, "m")] = Field((0.0, 0.0, 0.0), description="[m] of its middle")
    rotation: Annotated[Vector, Between(-360, 360, "deg")] = Field(
        (0.0, 0.0, 0.0), description="[deg] roll, pitch, yaw: about x, then y, then z of the world"
    )
    gaps: Annotated[tuple[Gap, ...], Between(-1e4, 1e4, "m")] = Field(
        (),
        description="[m] of a wall: middle along y from its own and width of each; a window with its lower and upper "
        "edge above the wall's foot as well",
    )
    mesh: Annotated[str | None, AfterValidator(pin_text)] = Field(None, description="path of an .obj or .stl file")
    travel: Annotated[Vector, Between(-1000, 1000, "m")] = Field(
        (0.0, 0.0, 0.0), description="[m] it moves along this to both sides of its position, by a sine of time"
    )
    period: Annotated[Float, Between(0.1, 1e6, "s")] = Field(10.0, description="[s] of that")
    phase: Annotated[Float, Between(-1, 1)] = Field(0.0, description="[-] of a period at the start")


class SceneConfig(Section):
    """Obstacles; drones, cables and payload must not touch them (docs/navigate.md)."""

    obstacles: tuple[ObstacleConfig, ...] = Field((), description="the obstacles")
    reserved: Int = Field(0, ge=0, le=200, description="further obstacles that the task may place in each episode")
