"""Plans of E teams whose drones plan for themselves, and tell each other what they will do.

Drone n's problem holds the payload and its own cable and thrust; those of the others are as they said last. It is that
of `riccati.py` for a team of one, whose payload feels the others' pulls, and their inertia along their cables. In a
sweep each drone moves some way to its own optimum, says so, and then rolls the payload alone under what it knows of all
(Jacobi's iteration; `sweep_shares` has the ways).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from multilift_marl.kernels.jit import kernel
from multilift_marl.planning.plan_messages import BYTES, SAID, Post, hear, said_at, seed_of
from multilift_marl.planning.riccati import IterationWork, Objective, Problem, find_gains, take_step
from multilift_marl.planning.soft_limits import Surroundings, TeamPoints
from multilift_marl.planning.team_model import (
    ModelWork,
    TeamModel,
    move_to_middle,
    pull_payload,
    set_rotation,
    state_size,
    step_state,
)
from multilift_marl.planning.team_planner import (
    Plans,
    TeamPlanner,
    is_finite,
    keep_targets,
    prepare_team,
    take_targets,
)
from multilift_marl.planning.team_weights import TeamWeights, weigh
from multilift_marl.rig.system import System
from multilift_marl.schema.planner import PlannerConfig
from multilift_marl.sensing.communication import Links
from multilift_marl.sim.obstacles import Obstacles

OWN = 19  # numbers of a drone's problem: payload 12, its cable 4, its thrust vector 3
SLOWEST = 0.8  # of what Chebyshev's iteration is for, see `sweep_shares`
MOMENTUM = 0.4  # of a damped sweep's change, that the next one adds


class ApartWork(NamedTuple):
    """Arrays that plans are made in."""

    iteration: IterationWork
    team: ModelWork
    states: np.ndarray
    """(K + 1, 19) of a drone's problem; targets, inputs and those asked for likewise."""
    inputs: np.ndarray
    targets: np.ndarray
    asked: np.ndarray
    loads: np.ndarray
    """(K, 49) see `team_model.accelerations`."""
    others: np.ndarray
    """(K + 1, N - 1, 4) see `Surroundings`."""
    all_targets: np.ndarray
    """(N, K + 1, 12 + 7 N) of each drone's plan of the team."""
    all_asked: np.ndarray
    """(N, K, 3 N)."""
    change: np.ndarray
    """(N, K + 1, 7) of each drone's own plan in a sweep."""
    input_change: np.ndarray
    """(N, K, 3)."""
    middle: np.ndarray
    weights: np.ndarray
    end: np.ndarray
    rate: np.ndarray
    start: np.ndarray

    @classmethod
    def of(cls, steps: int, n: int) -> ApartWork:
        """Return arrays for K steps of N drones."""
        size = state_size(n)
        shapes = (
            (steps + 1, OWN), (steps, 3), (steps + 1, OWN), (steps, 3), (steps, 49), (steps + 1, n - 1, 4),
            (n, steps + 1, size),
            (n, steps, 3 * n), (n, steps + 1, SAID), (n, steps, 3), (size,), (OWN,), (OWN,), (3,), (OWN,),
        )  # fmt: skip
        return cls(IterationWork.of(steps, 1), ModelWork.of(n), *(np.zeros(shape) for shape in shapes))


class DistributedPlanner(TeamPlanner):
    """Plans of E teams by their drones: plan e N + n is that of team e which drone n has, with its own part of it.

    Args:
        system, settings, num_envs, obstacles: see `TeamPlanner`.
        links: who hears whom; without delay after each sweep, else once in a policy step.
        exact: whether plans are made from exact states, see `sweep_shares`.

    Attributes:
        weights: (E N, ...) TeamWeights, live; of each plan those of the payload and of the drone that has it count.
    """

    def __init__(
        self, system: System, settings: PlannerConfig, num_envs: int, obstacles: Obstacles | None, links: Links,
        exact: bool = False,
    ):  # fmt: skip
        n, steps = system.num_drones, settings.steps
        super().__init__(system, settings, n * num_envs, obstacles)
        self.links = links
        self.shares = sweep_shares(settings.sweeps if links.delay == 0 else 1, n, exact)
        shape = num_envs, links.delay + 1, n, steps + 1, SAID
        self.post = Post(
            np.zeros(num_envs, np.uint64), np.zeros(num_envs, np.int64), np.zeros(shape), np.zeros((*shape[:3], 7)),
            np.zeros((num_envs, n, n, 7)), np.zeros((num_envs, n, n), bool), np.ones((num_envs, n, n), bool),
        )  # fmt: skip
        self.weights = TeamWeights.of(self.objective, n * num_envs)
        self._apart = ApartWork.of(steps, n)

    @property
    def message_bytes(self) -> int:
        """Of what a drone says at once, as single-precision numbers."""
        return BYTES * (SAID * (self.settings.steps + 1) + 7)

    def plan(
        self, states: np.ndarray, positions: np.ndarray, rotations: np.ndarray, elapsed: float,
        offsets: np.ndarray,
        loads: np.ndarray | None = None, shapes: np.ndarray | None = None,
    ) -> Plans:  # fmt: skip
        """See `TeamPlanner.plan`, with E N plans."""
        loads = self._agree(self._unloaded if loads is None else loads)
        given = self._given(states, positions, rotations, offsets, loads, shapes)
        settings = elapsed, self.settings.step, self.shares
        team = self._flat, self.objective, self.weights, self.around
        plan_apart(given, settings, team, (self.links, self.post), self.plans, self._work, self._apart)
        return self.plans

    def measure_ranges(self, positions: np.ndarray) -> None:
        """Note which drones the radio connects, by their true positions (E, N, 3) [m]."""
        apart = np.linalg.norm(positions[:, :, None] - positions[:, None], axis=-1)
        self.post.in_range[:] = apart <= self.links.range

    def _agree(self, loads: np.ndarray) -> np.ndarray:
        """Say loads (E N, 7) as each drone estimates them, and return the means of its own and those it has heard."""
        post, n = self.post, self.post.loads.shape[1]
        own = loads.reshape(-1, n, 7)
        # What was heard in an earlier episode is of another payload.
        begins = self.plans.fresh[::n]
        post.has_loads[begins] = False
        now = np.where(begins, 0, post.steps) % post.sent.shape[1]
        post.sent_loads[np.arange(len(now)), now] = own
        total = own + (post.loads * post.has_loads[..., None]).sum(axis=2)
        return (total / (1 + post.has_loads.sum(axis=2))[..., None]).reshape(-1, 7)


def sweep_shares(sweeps: int, n: int, exact: bool) -> np.ndarray:
    """Return how far each of some sweeps of N drones moves (S, 2): a share of the way, and of the last sweep's change.

    All move at once, each as if the others stayed: by whole steps what they want of the payload together is done N
    times over, what they want against each other once or less. From exact states, Chebyshev's iteration, which leaves
    least of all that is done `SLOWEST` to N times (Saad, Iterative methods for sparse linear systems, 2003, algorithm
    12.1). Noise moves plans in ways that it keeps: from other states, 1/N of the way, to the mean, and some momentum.
    """
    shares = np.tile([1.0 / n, MOMENTUM], (sweeps, 1))
    shares[0, 1] = 0.0
    if exact and sweeps > 1:
        middle, half = (n + SLOWEST) / 2, (n - SLOWEST) / 2
        left = half / middle
        shares[0, 0] = 1.0 / middle
        for share in shares[1:]:
            after = 1.0 / (2.0 * middle / half - left)
            share[:] = 2.0 * after / half, after * left
            left = after
    return shares


@kernel
def take_own(n, team, own):
    """Write the payload's and drone n's numbers (19,) of a team's vector (12 + 7 N,)."""
    q = 6 + 2 * ((team.shape[0] - 12) // 7)
    for i in range(6):
        own[i], own[8 + i] = team[i], team[q + i]
    for i in range(2):
        own[6 + i], own[14 + i] = team[6 + 2 * n + i], team[q + 6 + 2 * n + i]
    for i in range(3):
        own[16 + i] = team[2 * q + 3 * n + i]


@kernel
def set_others(n, states, inputs, h, model, load, work):
    """Write what the payload feels in each step beside drone n: the load (7,), and the others in its middle."""
    count = model.anchors.shape[0]
    for k in range(inputs.shape[0]):
        into = work.loads[k]
        into[:] = 0.0
        for i in range(7):
            into[i] = load[i]
        move_to_middle(states[k], inputs[k], h, model, work.middle)
        set_rotation(work.middle, work.team.rotation, work.team.turning)
        for m in range(count):
            if m == n:
                continue
            pull_payload(work.middle, m, 6 + 2 * count, model, work.team)
            # To the payload a drone on a taut cable is a force and, along that cable, its mass: m a aᵀ with the arm a.
            arm = work.team.arm[m]
            for i in range(6):
                into[7 + i] += arm[i] * work.team.pull[m]
                for j in range(6):
                    into[13 + 6 * i + j] += model.drone_mass[m] * arm[i] * arm[j]


@kernel
def place_others(n, states, model, separation, work):
    """Write where the other drones are beside the payload, and how far drone n is to stay from them (N, N) [m]."""
    count = model.anchors.shape[0]
    for k in range(states.shape[0]):
        set_rotation(states[k], work.team.rotation, work.team.turning)
        for m in range(count):
            if m == n:
                continue
            pull_payload(states[k], m, 6 + 2 * count, model, work.team)
            # Rows of the others alone: those after the own one move up.
            at, rotation = work.others[k, m - (m > n)], work.team.rotation
            for i in range(3):
                arm = 0.0
                for j in range(3):
                    arm += rotation[i, j] * model.anchors[m, j]
                at[i] = arm + model.length[m] * work.team.direction[m, i]
            at[3] = separation[n, m]


@kernel
def improve_own(n, start, states, inputs, problem, work):
    """Write to `work.states` and `work.inputs` the optimum of drone n, where the others do as in a team's plan.

    Args:
        n: the drone.
        start: (12 + 7 N,) of the team, as it knows it.
        states, inputs: of the team's plan.
        problem: Problem of the team, with one load.
        work: ApartWork.
    """
    model, objective, h = problem.model, problem.objective, problem.step
    set_others(n, states, inputs, h, model, problem.loads[0], work)
    place_others(n, states, model, objective.separation, work)
    for k in range(states.shape[0]):
        take_own(n, states[k], work.states[k])
        take_own(n, problem.targets[k], work.targets[k])
    for k in range(inputs.shape[0]):
        for i in range(3):
            work.inputs[k, i], work.asked[k, i] = inputs[k, 3 * n + i], problem.asked[k, 3 * n + i]
    take_own(n, objective.state, work.weights)
    take_own(n, objective.end, work.end)
    take_own(n, start, work.start)
    for i in range(3):
        work.rate[i] = objective.rate[3 * n + i]
    one = TeamModel(
        model.payload_mass, model.inertia, model.anchors[n : n + 1], model.drone_mass[n : n + 1],
        model.length[n : n + 1], model.drag,
    )  # fmt: skip
    own = Objective(
        work.weights, work.end, work.rate, objective.tension[n : n + 1], objective.thrust[n : n + 1],
        objective.separation[n : n + 1, n : n + 1], objective.weights,
    )  # fmt: skip
    around, points = problem.around, problem.around.points
    body = TeamPoints(points.corners, points.radius[n : n + 1], points.reach, points.clearance, points.weight)
    here = Surroundings(around.env, around.obstacles, around.ahead, body, around.others)
    alone = Problem(work.targets, work.asked, h, one, work.loads, own, here)
    find_gains(work.states, work.inputs, alone, 0.0, work.iteration)
    take_step(work.start, work.states, work.inputs, alone, work.iteration)


@kernel
def follow_load(states, inputs, h, model, load, w, after):
    """Write how the payload moves from the first state on, where cables and thrusts are as planned."""
    q = 6 + 2 * model.anchors.shape[0]
    for k in range(inputs.shape[0]):
        step_state(states[k], inputs[k], h, model, load, w, after)
        for i in range(6):
            states[k + 1, i], states[k + 1, q + i] = after[i], after[q + i]


@kernel
def plan_apart(given, settings, team, radio, plans, work, apart):
    """See `DistributedPlanner.plan`.

    Args:
        given, settings, team: see `plan_teams`, with `sweep_shares` in place of iterations, and TeamWeights after the
            objective.
        radio: Links, Post.
        plans: Plans, overwritten.
        work: PlannerWork.
        apart: ApartWork.
    """
    elapsed, h, shares = settings
    flat, objective, weights, around = team
    links, post = radio
    count = flat.model.anchors.shape[0]
    q, later = 6 + 2 * count, links.delay * elapsed / h
    for e in range(post.steps.shape[0]):
        first, kept = e * count, post.sent.shape[1]
        here = Surroundings(e, around.obstacles, around.ahead, around.points, apart.others)
        begins = plans.fresh[first]
        if begins:
            post.steps[e] = 0
            post.generator[e] = seed_of(given[0][first])
        for n in range(count):
            prepare_team(first + n, given, (elapsed, h), flat, plans, work)
            keep_rows(work.targets, apart.all_targets[n])
            keep_rows(work.asked, apart.all_asked[n])
        now = post.steps[e]
        if links.delay > 0 and now >= links.delay:
            hear(e, (now - links.delay) % kept, later, links, post, plans, h)
        # Momentum is of the sweeps of one policy step.
        apart.change[:] = 0.0
        apart.input_change[:] = 0.0
        for sweep in range(shares.shape[0]):
            for n in range(count):
                t = first + n
                states, inputs = plans.states[t], plans.inputs[t]
                # The drone knows the payload and itself as they are, the others as they said they would be.
                set_start(n, given[0][t], states, begins)
                follow_load(states, inputs, h, flat.model, given[1][t], apart.team, work.before[0])
                loads = given[1][t : t + 1]
                own = weigh(t, weights, objective)
                problem = Problem(apart.all_targets[n], apart.all_asked[n], h, flat.model, loads, own, here)
                improve_own(n, states[0], states, inputs, problem, apart)
                move_own(n, states, inputs, shares[sweep, 0], shares[sweep, 1], apart)
                for k in range(states.shape[0]):
                    for i in range(SAID):
                        post.sent[e, now % kept, n, k, i] = states[k, said_at(i, n, q)]
            if links.delay == 0:
                hear(e, now % kept, 0.0, links, post, plans, h)
        for n in range(count):
            t = first + n
            states, inputs = plans.states[t], plans.inputs[t]
            follow_load(states, inputs, h, flat.model, given[1][t], apart.team, work.before[0])
            plans.failed[t] = not is_finite(states, inputs)
            if plans.failed[t]:
                take_targets(states, inputs, apart.all_targets[n], apart.all_asked[n])
            keep_targets(t, apart.all_targets[n], plans)
        post.steps[e] = now + 1


@kernel
def set_start(n, start, states, whole):
    """Let a plan begin at the payload and drone n as they are, or, if `whole`, at the whole team."""
    count = (start.shape[0] - 12) // 7
    q = 6 + 2 * count
    for i in range(6):
        states[0, i], states[0, q + i] = start[i], start[q + i]
    for m in range(count):
        if m == n or whole:
            for i in range(SAID):
                states[0, said_at(i, m, q)] = start[said_at(i, m, q)]


@kernel
def move_own(n, states, inputs, share, momentum, work):
    """Move drone n's part of a plan by a share of the way to its optimum, and on as before by `momentum`."""
    q = 6 + 2 * (inputs.shape[1] // 3)
    change, input_change = work.change[n], work.input_change[n]
    for k in range(states.shape[0]):
        for i in range(SAID):
            at, own = said_at(i, n, q), i + 6 if i < 2 else i + 12
            change[k, i] = momentum * change[k, i] + share * (work.states[k, own] - states[k, at])
            states[k, at] += change[k, i]
    for k in range(inputs.shape[0]):
        for i in range(3):
            before = inputs[k, 3 * n + i]
            input_change[k, i] = momentum * input_change[k, i] + share * (work.inputs[k, i] - before)
            inputs[k, 3 * n + i] += input_change[k, i]


@kernel
def keep_rows(rows, into):
    """Copy rows."""
    for k in range(rows.shape[0]):
        for i in range(rows.shape[1]):
            into[k, i] = rows[k, i]
