"""How fast drones that plan for themselves agree: `python results/planner_consensus.py [drones=3,4,6] [starts=5]`.

Two couplings are compared from cold plans that hold a pose: damped Jacobi sweeps over cables and thrusts
(`planning/distributed_planner.py`, which flies), and the alternating direction method of multipliers (ADMM, Boyd et
al. 2011, section 7.3) over the payload's accelerations and the cables' wrenches, on the team linearised at rest. There
each drone plans its cable, its thrust and a copy of the accelerations; then one problem of the payload gives the
accelerations that all agree on, and a wrench of each cable. A number is the excess cost over the central optimum, as a
share of what that optimum saves; ADMM's penalties are the best of 100 pairs, for each number of exchanges (`best`) and
for all (`fixed`). Written to docs/data/planner_consensus.csv.
"""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterable
from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np
from script import read_options, run_script

from multilift_marl.config.config import Config
from multilift_marl.config.load import load_config
from multilift_marl.errors import ConfigError
from multilift_marl.planning.distributed_planner import DistributedPlanner
from multilift_marl.planning.expert import TeamExpert
from multilift_marl.planning.team_model import (
    ModelWork,
    pull_payload,
    set_rotation,
    state_size,
    step_state,
    swing_cable,
)
from multilift_marl.sensing.communication import Links

TABLE = Path(__file__).parents[1] / "docs" / "data" / "planner_consensus.csv"
EXCHANGES = 1, 3, 5, 10, 20, 40
PENALTIES = 10.0 ** np.arange(-3, 2, 0.5)
RELAXATION = 1.6  # of ADMM; 1.5 to 1.8 are usual
ACCELERATION = np.array([1.0, 1.0, 1.0, 5.0, 5.0, 5.0])  # units of its penalties [m/s², rad/s²]
EPSILON = 1e-5


def slopes(function: Callable[[np.ndarray], np.ndarray], at: np.ndarray, among: np.ndarray | None = None) -> np.ndarray:
    """Return the derivatives of a function by the numbers `among` (all), by central differences."""
    steps = EPSILON * np.eye(len(at))[slice(None) if among is None else among]
    return np.stack([(function(at + e) - function(at - e)) / (2 * EPSILON) for e in steps], axis=1)


def over_steps(a: np.ndarray, b: np.ndarray, steps: int) -> tuple[np.ndarray, np.ndarray]:
    """Return states 1 to K of x' = A x + B u by the first state, and by all inputs."""
    n, m = b.shape
    by_start, by_inputs = np.zeros((steps + 1, n, n)), np.zeros((steps + 1, n, steps, m))
    by_start[0] = np.eye(n)
    for k in range(steps):
        by_start[k + 1] = a @ by_start[k]
        by_inputs[k + 1] = np.einsum("ij,jkm->ikm", a, by_inputs[k])
        by_inputs[k + 1, :, k] = b
    return by_start[1:].reshape(-1, n), by_inputs[1:].reshape(-1, steps * m)


class Linear(NamedTuple):
    """States, costs and wrenches of a linear problem over K steps."""

    by_start: np.ndarray
    by_inputs: np.ndarray
    weights: np.ndarray
    """(K n,) of squared states."""
    rates: np.ndarray
    """(K m,) of squared inputs."""


class Drone(NamedTuple):
    """What a drone plans: the payload's copy, its cable and thrust by its thrust's rate and the accelerations."""

    own: np.ndarray
    """(19,) where its numbers are in the team's state."""
    plan: Linear
    wrench_by_start: np.ndarray
    wrench_by_inputs: np.ndarray


class Team:
    """A team at rest, linearised, as one problem and as one for each drone and the payload."""

    def __init__(self, config: Config):
        expert = TeamExpert(config)
        self.config, self.model, objective = config, expert.model, expert.objective
        self.n, self.steps, self.h = config.system.num_drones, config.planner.steps, config.planner.step
        self.rest = expert.rest_states(np.array([0.0, 0.0, 2.0]))[0]
        q, k, h = 6 + 2 * self.n, self.steps, self.h
        self.weights = np.vstack([np.tile(h * objective.state, (k - 1, 1)), objective.end])
        a = slopes(lambda x: self.step(x, np.zeros(3 * self.n)), self.rest)
        b = slopes(lambda u: self.step(self.rest, u), np.zeros(3 * self.n))
        self.whole = Linear(*over_steps(a, b, k), self.weights.ravel(), np.tile(h * objective.rate, k))
        weighted = self.whole.weights[:, None] * self.whole.by_inputs
        hessian = self.whole.by_inputs.T @ weighted + np.diag(self.whole.rates)
        self.optimum = -np.linalg.solve(hessian, weighted.T @ self.whole.by_start)
        self.load = np.r_[:6, q : q + 6]
        a = np.eye(12) + h * np.eye(12, k=6)
        b = np.vstack([0.5 * h * h * np.eye(6), h * np.eye(6)])
        self.payload = Linear(*over_steps(a, b, k), self.weights[:, self.load].ravel(), np.zeros(6 * k))
        self.mass = np.zeros((6, 6))
        self.mass[:3, :3], self.mass[3:, 3:] = self.model.payload_mass * np.eye(3), self.model.inertia
        self.drones = [self._drone(n, h * objective.rate[3 * n : 3 * n + 3]) for n in range(self.n)]

    def step(self, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        """Return the state after a step."""
        after = np.zeros_like(x)
        step_state(x, u, self.h, self.model, np.zeros(7), ModelWork.of(self.n), after)
        return after

    def law(self, n: int, x: np.ndarray, acceleration: np.ndarray) -> np.ndarray:
        """Return c̈ (2,) of cable n and its wrench (6,) on a payload that accelerates so."""
        w, q = ModelWork.of(self.n), 6 + 2 * self.n
        set_rotation(x, w.rotation, w.turning)
        pull_payload(x, n, q, self.model, w)
        w.acceleration[:6] = acceleration
        swing_cable(x, n, q, self.model, w)
        return np.concatenate([w.acceleration[6 + 2 * n : 8 + 2 * n], w.tension[n] * w.arm[n]])

    def _drone(self, n: int, rate: np.ndarray) -> Drone:
        q, h, k = 6 + 2 * self.n, self.h, self.steps
        own = np.r_[self.load, 6 + 2 * n + np.r_[:2], q + 6 + 2 * n + np.r_[:2], 2 * q + 3 * n + np.r_[:3]]
        by_state = slopes(lambda x: self.law(n, x, np.zeros(6)), self.rest, own)
        by_load = slopes(lambda a: self.law(n, self.rest, a), np.zeros(6))
        # In the middle of a step, where its accelerations are taken: inputs are the thrust's rate, then accelerations.
        middle, by_rate = np.eye(19), np.zeros((19, 9))
        middle[:6, 6:12] = 0.5 * h * np.eye(6)
        middle[12:14, 14:16] = 0.5 * h * np.eye(2)
        by_rate[16:, :3] = 0.5 * h * np.eye(3)
        out, by_input = by_state @ middle, by_state @ by_rate + np.hstack([np.zeros((8, 3)), by_load])
        faster, by_faster = np.zeros((8, 19)), np.zeros((8, 9))
        by_faster[:6, 3:] = np.eye(6)
        faster[6:], by_faster[6:] = out[:2], by_input[:2]
        a, b = np.eye(19), np.zeros((19, 9))
        for place, speed, part in ((np.r_[:6], np.r_[6:12], np.r_[:6]), (np.r_[12:14], np.r_[14:16], np.r_[6:8])):
            a[place, speed] += h
            a[place] += 0.5 * h * h * faster[part]
            a[speed] += h * faster[part]
            b[place], b[speed] = 0.5 * h * h * by_faster[part], h * by_faster[part]
        b[16:, :3] = h * np.eye(3)
        by_start, by_inputs = over_steps(a, b, k)
        before = np.vstack([np.eye(19), by_start[:-19]]), np.vstack([np.zeros((19, 9 * k)), by_inputs[:-19]])
        wrenches = [np.einsum("ij,kjm->kim", out[2:], each.reshape(k, 19, -1)) for each in before]
        for i in range(k):
            wrenches[1][i, :, 9 * i : 9 * i + 9] += by_input[2:]
        weights = self.weights[:, own].copy()
        weights[:, :12] = 0.0  # those of the payload are the payload's problem's
        plan = Linear(by_start, by_inputs, weights.ravel(), np.tile(np.r_[rate, np.zeros(6)], k))
        return Drone(own, plan, *(each.reshape(6 * k, -1) for each in wrenches))

    def excess(self, start: np.ndarray, inputs: np.ndarray) -> float:
        """Return the cost of inputs (K, 3 N) over the central optimum, as a share of what that saves."""
        w = self.whole

        def cost(u: np.ndarray) -> float:
            return float(w.weights @ (w.by_start @ start + w.by_inputs @ u) ** 2 + w.rates @ u**2)

        least = cost(self.optimum @ start)
        return (cost(inputs.ravel()) - least) / (cost(np.zeros_like(w.rates)) - least)

    def mean_excess(self, starts: np.ndarray, inputs: Iterable[np.ndarray]) -> float:
        """Return the mean of `excess` from several starts."""
        return float(np.mean([self.excess(start, each) for start, each in zip(starts, inputs, strict=True)]))


def jacobi(team: Team, start: np.ndarray, sweeps: int) -> np.ndarray:
    """Return what each drone plans to do (K, 3 N) after so many sweeps of the package's planner."""
    n, config = team.n, team.config
    links = Links(~np.eye(n, dtype=bool), 0, 0.0, np.inf)
    settings = config.planner.model_copy(update={"sweeps": sweeps})
    planner = DistributedPlanner(config.system, settings, 1, None, links, exact=True)
    shape = (n, *planner.times.shape)
    held = np.tile([0.0, 0.0, 2.0], (*shape, 1)), np.tile(np.eye(3), (*shape, 1, 1))
    plans = planner.plan(np.tile(team.rest + start, (n, 1)), *held, 0.0, np.zeros((n, shape[1], 12)))
    return np.concatenate([plans.inputs[i][:, 3 * i : 3 * i + 3] for i in range(n)], axis=1)


def admm(team: Team, starts: np.ndarray, penalties: tuple[float, float], exchanges: int) -> np.ndarray:
    """Return what each drone plans to do (exchanges, S, K, 3 N) after each exchange, from S starts."""
    n, k, payload = team.n, team.steps, team.payload
    by_copy, by_wrench = penalties
    mass = np.kron(np.eye(k), team.mass)
    copy = by_copy * np.tile(ACCELERATION**-2.0, k)
    inverse = np.linalg.inv(team.mass)
    wrench = by_wrench * n * np.kron(np.eye(k), inverse.T @ np.diag(ACCELERATION**-2.0) @ inverse)
    copies = np.tile(np.r_[np.zeros(3, bool), np.ones(6, bool)], k)
    inverses = []
    for d in team.drones:
        hessian = d.plan.by_inputs.T @ (d.plan.weights[:, None] * d.plan.by_inputs) + np.diag(d.plan.rates)
        hessian[np.ix_(copies, copies)] += np.diag(copy)
        inverses.append(np.linalg.inv(hessian + d.wrench_by_inputs.T @ wrench @ d.wrench_by_inputs))
    hessian = payload.by_inputs.T @ (payload.weights[:, None] * payload.by_inputs)
    agree = np.linalg.inv(hessian + n * np.diag(copy) + mass.T @ wrench @ mass / n)

    found = np.zeros((exchanges, len(starts), k, 3 * n))
    for s, start in enumerate(starts):
        load = payload.by_inputs.T @ (payload.weights * (payload.by_start @ start[team.load]))
        agreed, wrenches = np.zeros(6 * k), np.zeros((n, 6 * k))
        copy_price, wrench_price = np.zeros((n, 6 * k)), np.zeros((n, 6 * k))
        for each in range(exchanges):
            asked_copy, asked_wrench = np.zeros((n, 6 * k)), np.zeros((n, 6 * k))
            for i, d in enumerate(team.drones):
                own = start[d.own]
                right = d.plan.by_inputs.T @ (d.plan.weights * (d.plan.by_start @ own))
                right[copies] -= copy * (agreed - copy_price[i])
                drawn = wrenches[i] - wrench_price[i] - d.wrench_by_start @ own
                plan = -inverses[i] @ (right - d.wrench_by_inputs.T @ (wrench @ drawn))
                asked_copy[i], asked_wrench[i] = plan[copies], d.wrench_by_start @ own + d.wrench_by_inputs @ plan
                found[each, s, :, 3 * i : 3 * i + 3] = plan.reshape(k, 9)[:, :3]
            asked_copy = RELAXATION * asked_copy + (1 - RELAXATION) * agreed + copy_price
            asked_wrench = RELAXATION * asked_wrench + (1 - RELAXATION) * wrenches + wrench_price
            total = asked_wrench.sum(axis=0)
            agreed = agree @ (copy * asked_copy.sum(axis=0) + mass.T @ (wrench @ total) / n - load)
            wrenches = asked_wrench + (mass @ agreed - total) / n  # whose sum moves the payload so
            copy_price, wrench_price = asked_copy - agreed, asked_wrench - wrenches
    return found


def main(arguments: list[str]) -> None:
    """Compare, print, write."""
    values = read_options(arguments, {"drones": "3,4,6", "starts": 5})
    if wrong := [each for each in values["drones"].split(",") if not each.isdecimal()]:
        raise ConfigError(f"drones must be whole numbers, 3,4,6 say, but one is '{wrong[0]}'")
    rows = []
    for n in map(int, values["drones"].split(",")):
        team, rng = Team(load_config("hover", {"env.num_drones": n})), np.random.default_rng(0)
        q = 6 + 2 * n
        width = np.zeros(state_size(n))  # of displacements and velocities, small enough for linear plans
        width[:3], width[3:5], width[6:q], width[q : q + 3] = 0.01, 0.005, 0.003, 0.02
        starts = width * rng.normal(size=(values["starts"], len(width)))
        kinds = {"jacobi": [team.mean_excess(starts, [jacobi(team, s, e) for s in starts]) for e in EXCHANGES]}
        flown = [admm(team, starts, pair, max(EXCHANGES)) for pair in product(PENALTIES, PENALTIES)]
        table = np.array([[team.mean_excess(starts, found[e - 1]) for e in EXCHANGES] for found in flown])
        kinds["admm, best"] = list(table.min(axis=0))
        kinds["admm, fixed"] = list(table[np.log(table[:, 1:5]).sum(axis=1).argmin()])
        for kind, excess in kinds.items():
            rows.append([n, kind, *(f"{100 * e:.2f}" for e in excess)])
            print(*rows[-1], flush=True)
    with TABLE.open("w", encoding="utf-8", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows(
            [["drones", "coupling", *(f"excess_percent_after_{e}" for e in EXCHANGES)], *rows]
        )


if __name__ == "__main__":
    run_script(main)
