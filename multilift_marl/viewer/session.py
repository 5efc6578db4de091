"""A simulation to watch: one environment, a policy, and what a spectator may do to them."""

from __future__ import annotations

import functools
import threading
from collections.abc import Callable
from typing import Any

import numpy as np

from multilift_marl.agents.policy import TrainedPolicy
from multilift_marl.config.config import Config
from multilift_marl.envs.core import EVALUATION, MultiliftVec
from multilift_marl.errors import ConfigError, nearest
from multilift_marl.policies.baselines import check_interface, fitting_scripts, make_scripted
from multilift_marl.policies.policy import Policy

_MOST_STEPS = 20  # at once: on a machine that is too slow the simulation falls behind the clock
PUSH_SECONDS = 0.5


class Session:
    """Episodes of one environment, one after the other, simulated in step with the clock.

    Every method may be called from any thread.

    Args:
        config: the environment.
        named: policies by name, beside the baselines that fit.
        policy: name of the first one, of `named` or a baseline; None for the first that fits.
        seed: of the episodes, those of `evaluate.py`.

    Attributes:
        vec: the environment.
        policies: names of the policies that fit it.
        policy: name of the present one.
        paused: whether the clock is stopped.
        speed: simulated seconds in a second.
        outcome: how the last episode ended, in words.

    Raises:
        ConfigError: there is no such policy, or it does not fit the environment.
    """

    def __init__(self, config: Config, named: dict[str, Any], policy: str | None = None, seed: int = 1000):
        if isinstance(mine := named.get(policy or ""), TrainedPolicy) and (reason := mine.misfit_config(config)):
            raise ConfigError(f"the policy {policy} {reason}")
        if policy is not None:
            check_interface(policy, config.control.action, "policy")
        self.vec = vec = MultiliftVec(config, EVALUATION)
        self._lock = threading.RLock()
        self._makers = _fitting(vec, named)
        self.policies = tuple(self._makers)
        self.policy = self._checked(policy if policy is not None else next(iter(self._makers), "none"), named)
        self._policy, self._chosen = self._makers[self.policy](vec), self.policy
        self.paused = False
        self.speed = 1.0
        self.outcome = ""
        self._behind = 0.0  # [s] of simulated time that the clock is ahead
        self._calm = np.zeros(3)  # [N] on the payload without a push
        self._push_left = 0  # policy steps
        self._observation, _ = vec.reset(seed=seed)
        self._policy.reset()

    def advance(self, seconds: float) -> int:
        """Let the clock run on by `seconds` of the spectator's time; return how many policy steps were taken."""
        with self._lock:
            if self.paused:
                return 0
            self._behind = min(self._behind + seconds * self.speed, _MOST_STEPS * self.vec.task.dt)
            steps = int(self._behind / self.vec.task.dt)
            for _ in range(steps):
                self.step()
            self._behind -= steps * self.vec.task.dt
            return steps

    def step(self) -> None:
        """Take one policy step; after the end of an episode, start the next."""
        with self._lock:
            vec = self.vec
            if vec.ended[0]:
                self._observation, _ = vec.reset()
                self._start()
                return
            self._observation, _, terminated, _, info = vec.step(self._policy.act(self._observation))
            if self._push_left:
                self._push_left -= 1
                if not self._push_left:
                    vec.world.hidden_loads.payload_force[0] = self._calm
            if vec.ended[0]:
                cause = vec.failure_causes[info["failure_cause"][0]]
                ended = "success" if info["success"][0] else f"failure: {cause}" if terminated[0] else "no success"
                self.outcome = f"episode {vec.episodes[0]}: {ended}, {100 * vec.task.errors.distance[0]:.1f} cm"

    def reset(self) -> None:
        """Start the episode in progress anew."""
        with self._lock:
            vec = self.vec
            # `reset` goes to the next episode.
            vec.episodes[0] -= 1
            self._observation, _ = vec.reset()
            self._start()

    def skip(self) -> None:
        """Start the next episode."""
        with self._lock:
            self._observation, _ = self.vec.reset()
            self._start()

    def choose(self, policy: str) -> None:
        """Let another policy control the team, as soon as its kernels are compiled.

        Raises:
            ConfigError: there is no such policy here.
        """
        self._chosen = self._checked(policy, {})
        # The first step of a policy may compile for seconds, in which the team flies on.
        fresh = self._makers[policy](self.vec)
        fresh.reset()
        fresh.act(self._observation.copy())
        with self._lock:
            if self._chosen == policy:  # not another one meanwhile
                self.policy, self._policy = policy, fresh
                self._policy.reset()

    def push(self, heading: float, elevation: float, force: float) -> None:
        """Push the payload for PUSH_SECONDS.

        Args:
            heading: of the force, from x towards y [deg].
            elevation: above the horizontal plane [deg].
            force: its strength [N].
        """
        with self._lock:
            azimuth = np.deg2rad(heading)
            up = np.deg2rad(elevation)
            direction = [np.cos(up) * np.cos(azimuth), np.cos(up) * np.sin(azimuth), np.sin(up)]
            hidden_loads = self.vec.world.hidden_loads
            if not self._push_left:
                self._calm = hidden_loads.payload_force[0].copy()
            hidden_loads.payload_force[0] = self._calm + force * np.array(direction)
            self._push_left = max(1, round(PUSH_SECONDS / self.vec.task.dt))

    def locked(self) -> threading.RLock:
        """Return the lock that keeps the environment as it is while it is held."""
        return self._lock

    def status(self) -> str:
        """Return the state of the episode in words (Markdown)."""
        with self._lock:
            vec, errors = self.vec, self.vec.task.errors
            tension = vec.world.state.cable_tension[0]
            lines = (
                f"**{vec.task.name}**, {vec.num_drones} drones, episode {vec.episodes[0]}",
                f"{vec.steps[0] * vec.task.dt:.1f} of {vec.max_steps * vec.task.dt:g} s",
                f"payload {100 * errors.distance[0]:.1f} cm and {np.rad2deg(errors.angle[0]):.1f}° off",
                f"tension {tension.min():.2f} to {tension.max():.2f} N",
                self.outcome,
            )
            return "  \n".join(line for line in lines if line)

    def _start(self) -> None:
        self._push_left = 0
        self._behind = 0.0
        self._policy.reset()

    def _checked(self, policy: str, named: dict[str, Any]) -> str:
        if policy in named and policy not in self._makers:
            raise ConfigError(f"the policy {policy} {named[policy].misfit(self.vec)}")
        if policy not in self._makers:
            raise ConfigError(f"unknown policy '{policy}'{nearest(policy, self._makers)}")
        return policy


def _fitting(vec: MultiliftVec, named: dict[str, Any]) -> dict[str, Callable[[MultiliftVec], Policy]]:
    """Return the makers of all policies that fit, those that are `named` and no such baseline first."""
    baselines = {name: functools.partial(make_scripted, name) for name in fitting_scripts(vec)}
    first = {name: policy.bind for name, policy in named.items() if name not in baselines and not policy.misfit(vec)}
    return first | baselines
