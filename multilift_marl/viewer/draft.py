"""A rig that is refused, to look at: nothing moves, and the page says why."""

from __future__ import annotations

import threading

from multilift_marl.config.config import Config
from multilift_marl.rendering.draft import Draft


class DraftSession:
    """Shows a refused rig where a `Session` flies a team.

    Args:
        config: of the rig.

    Attributes:
        vec: the still rig.
        reason: why it is refused, in one sentence.

    Raises:
        ConfigError: not even a picture of it can be made.
    """

    def __init__(self, config: Config):
        self.vec = Draft(config)
        self.reason = str(self.vec.conflict)
        self._lock = threading.RLock()

    def advance(self, seconds: float) -> int:
        """Take no steps."""
        return 0

    def locked(self) -> threading.RLock:
        """Return the lock that a page draws under."""
        return self._lock

    def status(self) -> str:
        """Return why the rig is refused, and what is red (Markdown)."""
        parts = [("drone", self.vec.conflict.drones), ("anchor", self.vec.conflict.anchors)]
        marked = [f"{part} {number}" for part, numbers in parts for number in numbers]
        lines = (f"**This rig is refused:** {self.reason}", f"red: {', '.join(marked)}" if marked else "")
        return "  \n".join(line for line in lines if line)
