"""The report's state machine: the stages of a flight, and who may hold it back or end it."""

from __future__ import annotations

from enum import IntEnum


class Stage(IntEnum):
    """Of a drone's flight, on /state/state_drone_<i> and /state/command_drone_<i>."""

    INIT = 0
    ARMING = 1
    TAKE_OFF = 2
    GO_TO = 3
    HOVER = 4
    TRAJECTORY = 5
    END = 6
    LAND = 7


class Orders:
    """What a flight asks before it goes on; here nobody has a say."""

    def may_begin(self, stage: Stage) -> bool:
        """Return whether a stage may begin."""
        return True

    def why_to_land(self) -> str:
        """Return why the team is to land now; empty if it is not."""
        return ""
