"""Training through the planner: its weights follow the gradient of tracking errors, `train.algorithm=diffmpc`.

A network says, by each drone's observation, what weighs how much in the team's plan (`control.action=planner_weights`).
Flights of a few steps are differentiated by these weights (`diffmpc/sensitivity.py`), along the states that the
simulation went through, with the Jacobians of the planner's model, the lag of the rotors, and the delay of actions that
the simulation has drawn; observations count as given. The network follows that gradient by Adam. Auto-Multilift (Wang
et al., arXiv 2406.04858) learns so, with a new Adam in every step: by signs alone.
"""

from __future__ import annotations

import time
from math import exp

import numpy as np
import torch

from multilift_marl.agents.learning_rollouts import LearningRollouts, join_steps, list_step
from multilift_marl.agents.mappo import Learner, check_finite
from multilift_marl.agents.rollouts import Batches
from multilift_marl.diffmpc.weighted_planner import FlightGradient, WeightedPlanner
from multilift_marl.envs.core import MultiliftVec
from multilift_marl.envs.torchrl_env import MultiliftEnv
from multilift_marl.errors import ConfigError
from multilift_marl.planning.team_weights import TeamWeights
from multilift_marl.policies.planner_weights import PlannerWeights
from multilift_marl.schema.planner import PlannerConfig
from multilift_marl.schema.training import TrainConfig


def check_diffmpc(train: TrainConfig, action: str, planner: PlannerConfig) -> None:
    """Refuse, by a ConfigError, what cannot be trained through a planner."""
    if planner.distributed:
        raise ConfigError(
            "train.algorithm=diffmpc follows derivatives of the team's plan; set planner.distributed=false, and "
            "true to fly what was learned"
        )
    if action != "planner_weights":
        raise ConfigError(
            f"train.algorithm=diffmpc learns the weights of a planner; set control.action=planner_weights, not {action}"
        )
    if planner.lead is not None:
        raise ConfigError(
            "train.algorithm=diffmpc has the derivatives of plans that lead as much as the rotors lag; leave "
            "planner.lead out"
        )
    for key in ("gru", "workers", "rigs"):
        if getattr(train, key):
            raise ConfigError(f"train.algorithm=diffmpc has no train.{key}; leave it out, or take mappo")
    window, horizon = train.diffmpc.window, train.horizon
    if horizon <= window:
        raise ConfigError(
            f"train.horizon={horizon} holds no window of train.diffmpc.window={window} steps and the state after it; "
            "raise the one or lower the other"
        )


def loss_weights(train: TrainConfig, vec: MultiliftVec) -> np.ndarray:
    """Return the weights (12 + 7 N,) of squared deviations from targets in the loss."""
    position, attitude, cable, velocity, rates, swing = train.diffmpc.loss
    n = vec.num_drones
    moving = [velocity] * 3 + [rates] * 3 + [swing] * (2 * n)
    return np.array([position] * 3 + [attitude] * 3 + [cable] * (2 * n) + moving + [0.0] * (3 * n))


class DiffMpcRollouts(LearningRollouts):
    """Flights that the learner's policy is improved by on the way; see `LearningRollouts`."""

    def __init__(self, env: MultiliftEnv, learner: Learner, total: int):
        super().__init__(env, learner, total)
        commander = env.vec.commander
        assert isinstance(commander, PlannerWeights) and isinstance(commander.planner, WeightedPlanner)
        self._commander = commander
        vec, train, planner = env.vec, learner.config, env.vec.config.planner
        self._settings, self._horizon = train.diffmpc, train.horizon
        slowest = max(vehicle.rotor_time_constant for vehicle in vec.world.system.vehicles)
        response = 1.0 - exp(-vec.task.dt / slowest) if slowest else 1.0
        self._planner = commander.planner
        self._expected = round(planner.delay / vec.task.dt)
        self._flight = FlightGradient(self._planner, self._settings.window, vec.task.dt, response)
        self._loss = loss_weights(train, vec)
        shape = self._settings.window + 1, vec.num_envs, vec.num_drones
        self._observed = np.zeros((*shape, vec.observation_size), np.float32)

    def collect(self, iteration: int) -> Batches:
        """See `LearningRollouts.collect`."""
        vec, window = self.env.vec, self._settings.window
        every = min(self._settings.every or window, window)
        self.start()
        observation, _ = vec.current()
        rows: list[dict[str, np.ndarray]] = []
        losses: list[float] = []
        norms: list[float] = []
        cuts: list[float] = []
        seconds, slot = 0.0, 0
        for _ in range(self._horizon):
            self._fly(observation, slot, rows)
            observation = vec.outcome.observation.copy()
            slot += 1
            if slot <= window:
                continue
            begin = time.perf_counter()
            loss, norm = self._learn()
            check_finite(self._learner, iteration)  # it flies on with them
            losses.append(loss)
            norms.append(norm)
            cuts.append(float(self._flight.tape.cut[:-1].mean()))
            self._shift(every)
            slot -= every
            seconds += time.perf_counter() - begin
        self.values = {
            "loss": float(np.mean(losses)), "gradient": float(np.mean(norms)), "cut": float(np.mean(cuts)),
            "learning_seconds": seconds,
        }  # fmt: skip
        return [join_steps(rows, vec)]

    def _fly(self, observation: np.ndarray, slot: int, rows: list[dict[str, np.ndarray]]) -> None:
        """Make a step, and keep what its derivatives need in a slot of the window."""
        vec, flight, planner = self.env.vec, self._flight, self._planner
        action = self.act(observation)
        self._observed[slot] = observation
        planner.slot = slot
        began = vec.ended
        outcome = vec.step_live(action, restart=True)
        for kept, weights in zip(flight.weights, planner.weights, strict=True):
            kept[slot] = weights
        rows.append(list_step(outcome, vec))
        # Nor do plans that are not flown teach: those that came late, or of teams whose states are unknown.
        flight.tape.cut[slot] |= rows[-1]["done"][:, 0] | began | ~self._commander.follows
        # A plan begins where the team will be after `planner.delay`, and so does what the tape keeps.
        flight.tape.late[slot] = np.maximum(vec.task.view.action_delay - self._expected, 0)

    def _learn(self) -> tuple[float, float]:
        """Follow the gradient of the flights in the window once; return their loss and the gradient's norm."""
        learner, settings, flight = self._learner, self._settings, self._flight
        off = np.moveaxis(flight.tape.off[:, :, 0], 0, 1)
        off = np.where(np.isfinite(off), off, 0.0)
        costs = off * self._loss
        costs[:, 0] = 0.0
        gradient = flight.find(costs)
        weights = TeamWeights(*(each[:-1] for each in flight.weights))
        by_action = np.nan_to_num(self._commander.pull_back(gradient, weights)) / off.shape[0]
        observed = torch.from_numpy(self._observed[:-1])
        mean = learner.actor(observed)[0]
        slope = torch.from_numpy(by_action.astype(np.float32))
        # What is beyond the bounds of actions counts where it would come back.
        outside = (mean.detach().abs() > 1) & (slope * mean.detach() < 0)
        learner.optimizer.zero_grad()
        (mean * slope.masked_fill(outside, 0.0)).sum().backward()
        parameters = [each for each in learner.actor.parameters() if each.grad is not None]
        norm = torch.nn.utils.clip_grad_norm_(parameters, learner.config.max_grad_norm)
        if settings.fresh_adam:
            learner.optimizer.state.clear()
        learner.optimizer.step()
        learner.actor.normalizer.update(observed)
        return float(0.5 * (off**2 * self._loss)[:, 1:].sum(axis=2).mean()), float(norm)

    def _shift(self, every: int) -> None:
        """Let the window move on by so many steps."""
        tape = self._flight.tape
        by_env = tape.states, tape.inputs, tape.loads
        for array in by_env:
            array[:, :-every] = array[:, every:].copy()
        by_step = [array for array in tape if not any(array is other for other in by_env)]
        for array in (*by_step, *self._flight.weights, self._observed):
            array[:-every] = array[every:].copy()
