"""What a parameter may be, and the group of parameters that every section of the configuration is."""

from __future__ import annotations

from dataclasses import dataclass
from math import pi
from typing import Annotated, Any

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, GetCoreSchemaHandler
from pydantic_core import CoreSchema
from pydantic_core.core_schema import no_info_after_validator_function


def _integer(value: Any) -> Any:
    """Accept 2e6, which PyYAML reads as a string, where a whole number is meant; refuse true and false."""
    if isinstance(value, bool):
        raise ValueError("must be a whole number")
    if isinstance(value, str | float):
        try:
            number = float(value)
        except ValueError:
            raise ValueError("must be a whole number") from None
        if not number.is_integer():
            raise ValueError("must be a whole number")
        value = int(number)
    if isinstance(value, int) and abs(value) >= 2**63:
        raise ValueError("must be a whole number below 2**63")
    return value


def _real(value: Any) -> Any:
    """Accept 1e-3, which PyYAML reads as a string; refuse true and false."""
    if isinstance(value, bool):
        raise ValueError("must be a number")
    if isinstance(value, str):
        try:
            return float(value)
        except ValueError:
            raise ValueError("must be a number") from None
    return value


Int = Annotated[int, BeforeValidator(_integer)]
Float = Annotated[float, BeforeValidator(_real)]
Vector = tuple[Float, Float, Float]
Positive = Annotated[Float, Field(gt=0)]
NotNegative = Annotated[Float, Field(ge=0)]
PerDrone = Positive | tuple[Positive, ...]
NotNegativePerDrone = NotNegative | tuple[NotNegative, ...]
FloatPerDrone = Float | tuple[Float, ...]
Lean = Annotated[Float, Field(ge=0, lt=80)]
VectorPerDrone = Vector | tuple[Vector, ...]
Four = tuple[Float, Float, Float, Float]
FourPerDrone = Four | tuple[Four, ...]
Moments = tuple[Positive, Positive, Positive]
Drag = tuple[NotNegative, NotNegative, NotNegative]
Links = Annotated[Int, Field(ge=2, le=100)]
Share = Annotated[Float, Field(ge=0, lt=1)]


def _level(value: Any) -> Any:
    """Accept the named levels of the observations' imperfections."""
    if isinstance(value, str) and value in (levels := {"none": 0.0, "standard": 1.0}):
        return levels[value]
    try:
        return _real(value)
    except ValueError:
        raise ValueError("must be none, standard, or a factor on standard") from None


UNITS = {
    "m": {"mm": 1e-3, "cm": 1e-2, "inch": 0.0254, "ft": 0.3048},
    "kg": {"g": 1e-3},
    "kg m²": {"g m²": 1e-3, "kg cm²": 1e-4, "kg mm²": 1e-6, "g cm²": 1e-7, "g mm²": 1e-9},
    "kg/m": {"g/m": 1e-3},
    "m²": {"cm²": 1e-4, "mm²": 1e-6},
    "m/s": {"cm/s": 1e-2, "mm/s": 1e-3},
    "s": {"ms": 1e-3, "µs": 1e-6, "ns": 1e-9},
    "N": {"gf": 9.80665e-3},
    "rad": {"deg": pi / 180},
    "rad/s": {"rpm": pi / 30, "deg/s": pi / 180},
}
"""Other units that people give for one, and the factor to it."""


@dataclass(frozen=True)
class Between:
    """Says of a number, or of all numbers in a list, that they are from `low` to `high` in `unit`; None passes."""

    low: float
    high: float
    unit: str = ""

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        """Check the value after all else is known to be right."""
        return no_info_after_validator_function(self._check, handler(source))

    def _check(self, value: Any) -> Any:
        if isinstance(value, tuple):
            for part in value:
                self._check(part)
        elif value is not None and not self.low <= value <= self.high:
            others = UNITS.get(self.unit, {}).items() if value > self.high else ()
            fitting = [name for name, factor in others if self.low <= value * factor <= self.high]
            error = ValueError(f"must be from {self.low:g} to {self.high:g} {self.unit}".rstrip())
            error.add_note(f"; is it in {' or '.join(fitting)}?" if fitting else "")
            raise error
        return value


def _range(value: Any) -> Any:
    """Accept one number for a range of one."""
    return value if isinstance(value, list | tuple) else (value, value)


def _rising(value: tuple[float, float]) -> tuple[float, float]:
    if value[0] > value[1]:
        raise ValueError(f"must not end at {value[1]:g} before it begins at {value[0]:g}")
    return value


def _choice(value: Any) -> Any:
    """Accept one name for a choice of one."""
    return (value,) if isinstance(value, str) else value


def _rise_from_now(value: int | tuple[int, ...]) -> int | tuple[int, ...]:
    if isinstance(value, tuple) and (value[:1] != (0,) or list(value) != sorted(set(value))):
        raise ValueError("must be a number of steps, or rise from 0, such as [0, 2, 8]")
    return value


def _places(value: Any) -> Any:
    """Refuse a list of anything but lists of three or four, with which pydantic's message would be of text."""
    shaped = isinstance(value, list | tuple) and all(isinstance(each, list | tuple) for each in value)
    if not isinstance(value, str | None) and not (shaped and all(len(each) in (3, 4) for each in value)):
        raise ValueError("must be a CSV file or a list of places [x, y, z] or [x, y, z, yaw]")
    return value


Ages = tuple[Annotated[Int, Field(ge=0, le=1000)], ...]
History = Annotated[Annotated[Int, Field(ge=1, le=50)] | Ages, AfterValidator(_rise_from_now)]
Level = Annotated[Float, Field(ge=0), BeforeValidator(_level)]
Places = Annotated[str | tuple[tuple[Float, ...], ...] | None, BeforeValidator(_places)]
Delay = Annotated[Int, Field(ge=0, le=50)]
Span = Annotated[tuple[Positive, Positive], BeforeValidator(_range), AfterValidator(_rising)]
Count = Annotated[Int, Field(ge=1, le=1000)]
Counts = Annotated[tuple[Count, Count], BeforeValidator(_range), AfterValidator(_rising)]
Shares = Annotated[tuple[Float, Float], BeforeValidator(_range), AfterValidator(_rising), Between(0, 1)]
Choice = BeforeValidator(_choice)
Delays = Annotated[tuple[Delay, Delay], BeforeValidator(_range)]


class Section(BaseModel):
    """A frozen group of parameters that rejects unknown keys and values of the wrong type."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)
