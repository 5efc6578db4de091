"""A flight that others publish on ROS 2 topics, to look at: nothing is simulated, and the flight does not wait."""

from __future__ import annotations

import threading
import time
from dataclasses import replace
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np

from multilift_marl.config.config import Config
from multilift_marl.math3d import mat_to_quat
from multilift_marl.rendering.draft import place_at_rest

if TYPE_CHECKING:
    from multilift_marl.deploy.ros.dds import Node

_SILENT = 1.0  # [s] after which it is said of whom nothing new is heard
_LEAP = 1.0  # [m] of the payload between two pictures, beyond which it was put elsewhere and trails begin anew


class LiveTeam:
    """One environment as it is heard, which a `Stage` draws like others; cables are straight.

    What has not been heard yet is at rest in mid-air, the target at the payload.

    Args:
        config: of the rig.
        node: subscribes.
        names: of the topics, a key of `messages.NAMES`.

    Attributes:
        heard: the newest of each.
    """

    def __init__(self, config: Config, node: Node, names: str = "multilift"):
        from multilift_marl.deploy.ros.spectator import Spectator

        system = replace(config.system, cable_model="massless")
        self.num_envs, self.num_drones = 1, system.num_drones
        self.heard = Spectator(system.num_drones, node, names)
        # A trail lasts as long as by the clock of the flight, of which a step is a nanosecond.
        self.steps, self.seeds, self.episodes = np.zeros(1, np.int64), np.zeros(1, int), np.zeros(1, int)
        self.world: Any = place_at_rest(system)
        position = self.world.state.payload_position.copy()
        goal = SimpleNamespace(position=position, rotation=np.eye(3)[None], yaw=np.zeros(1))
        self.task: Any = SimpleNamespace(
            name=config.task, dt=1e-9, goal=goal, target_path=lambda env: self.heard.path, scenery=lambda env: [],
        )  # fmt: skip
        # Of payload and drones, in MuJoCo's coordinates: an attitude follows each position but that of a point.
        first = 3 if system.payload_shape == "point" else 7
        qpos = self.world.qpos(0)
        self._poses = [*(qpos[at : at + 7] for at in range(first, len(qpos), 7)), qpos[:first]]

    def poll(self, now: float) -> None:
        """Take in what has come, at a time by this machine's clock [s]."""
        self.heard.poll(now)
        bodies, state, goal = self.heard.bodies, self.world.state, self.task.goal
        for body in np.flatnonzero(bodies.stamps >= 0).tolist():
            position, rotation = bodies.pose(body)
            pose = self._poses[body]
            pose[:3] = position
            if len(pose) > 3:
                pose[3:] = mat_to_quat(tuple(rotation.ravel().tolist()))
        if np.linalg.norm(self._poses[-1][:3] - state.payload_position[0]) > _LEAP:
            self.episodes += 1
        state.payload_position = self._poses[-1][None, :3].copy()
        state.drone_position = np.stack([pose[:3] for pose in self._poses[:-1]])[None]
        target = self.heard.target
        goal.position[0], goal.rotation[0] = (state.payload_position[0], np.eye(3)) if target is None else target
        if self.heard.tension is not None:
            state.cable_tension = self.heard.tension[None]
        self.steps[0] = max(bodies.stamps[-1], 0)


class LiveSession:
    """Shows a flight where a `Session` simulates one; it may begin later, end, and begin again.

    Args:
        config: of the rig.
        node: subscribes.
        names: of the topics, a key of `messages.NAMES`.

    Attributes:
        vec: the flight as it is heard.
    """

    def __init__(self, config: Config, node: Node, names: str = "multilift"):
        self.vec = LiveTeam(config, node, names)
        self._names = names
        self._lock = threading.RLock()

    def advance(self, seconds: float) -> int:
        """Take in what has come; take no steps."""
        with self._lock:
            self.vec.poll(time.perf_counter())
        return 0

    def locked(self) -> threading.RLock:
        """Return the lock that a page draws under."""
        return self._lock

    def status(self) -> str:
        """Return what is heard of the flight in words (Markdown)."""
        with self._lock:
            heard, world = self.vec.heard, self.vec.world
            lines = [f"**live flight**, {self.vec.num_drones} drones, topics of names={self._names}", self._silence()]
            if heard.bodies.stamps[-1] >= 0:
                lines.append(f"{heard.bodies.stamps[-1] * 1e-9:.1f} s")
            lines.append(self._stage())
            if heard.target is None:
                lines.append("no /target is heard")
            else:
                off = np.linalg.norm(world.state.payload_position[0] - heard.target[0])
                lines.append(f"payload {100 * off:.1f} cm off")
            if heard.tension is not None:
                lines.append(f"tension {heard.tension.min():.2f} to {heard.tension.max():.2f} N")
            return "  \n".join(line for line in lines if line)

    def _silence(self) -> str:
        """Return of whom nothing new is heard."""
        bodies, now = self.vec.heard.bodies, time.perf_counter()
        if not (missing := bodies.missing(now, _SILENT)):
            return ""
        if len(missing) < len(bodies.stamps):
            return f"nothing is heard of {', '.join(missing)}"
        if (bodies.stamps < 0).all():
            return "**no flight is heard** yet"
        return f"**no flight is heard** for {now - bodies.arrivals.max():.0f} s: the last picture"

    def _stage(self) -> str:
        """Return the stages of the drones; nothing where none has one."""
        from multilift_marl.deploy.ros.stages import Stage

        known = {int(stage) for stage in Stage}
        names = [Stage(s).name.lower().replace("_", "-") if s in known else "?" for s in self.vec.heard.stages.tolist()]
        if set(names) == {"?"}:
            return ""
        return f"stage {names[0]}" if len(set(names)) == 1 else f"stages {', '.join(names)}"
