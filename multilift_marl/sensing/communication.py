"""Communication of drones about the payload: where their cables end, over links that lose and delay messages.

`env.communication` says whom a drone hears. A message is heard `env.communication_delay` steps after it was sent, with
the probability 1 - `env.communication_loss`, and only where the two are closer than `env.communication_range` when it
arrives. What was last heard stays until it is replaced, with its age. Each drone then fits the payload to all anchors
that it knows.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from multilift_marl.errors import ConfigError
from multilift_marl.kernels.jit import kernel
from multilift_marl.math3d import (
    add,
    cross,
    dot,
    matmul,
    matrow,
    mul,
    norm,
    put,
    rotation_vector,
    row,
    scale,
    sub,
    transpose,
    turn_by,
    vec,
)
from multilift_marl.rng import uniform
from multilift_marl.schema.sections import EnvConfig
from multilift_marl.sensing.load_filter import assume_planned, follow_attitude, follow_position, predict_position

MAX_AGE = 0.5  # [s] what was heard longer ago is not used
ATTITUDE_PRIOR = 0.02 / 0.1  # [m] of an anchor's error over [rad] of a payload's attitude about the planned one
NEVER = 1 << 30
"""Age of what has not been heard in this episode [steps]."""


class Links(NamedTuple):
    """Who hears whom, and how well."""

    partners: np.ndarray
    """(N, N) whether the first hears the second."""
    delay: int
    """[steps]."""
    loss: float
    """Probability that a message is lost."""
    range: float
    """Of the radio [m]."""


class Messages(NamedTuple):
    """What has been sent and heard; environment first."""

    generator: np.ndarray
    """(E,) uint64, state of the random numbers."""
    steps: np.ndarray
    """(E,) since the reset."""
    sent: np.ndarray
    """(E, K, N, 3) positions of the last steps, at their number modulo K [m]."""
    has_sent: np.ndarray
    """(E, K, N) whether there was anything to send."""
    heard: np.ndarray
    """(E, N, N, 3) what the first last heard of the second [m]."""
    age: np.ndarray
    """(E, N, N) of it [steps]."""


class Broadcast(NamedTuple):
    """What drones send in a step, and from where; live arrays."""

    position: np.ndarray
    """(E, N, 3) of the drones, true [m]."""
    content: np.ndarray
    """(E, N, 3) what each has to send [m]."""
    has_message: np.ndarray
    """(E, N) whether it has."""


def check_links(env: EnvConfig) -> None:
    """Refuse, by a ConfigError, communication that could transmit nothing."""
    if env.sensing != "onboard":
        raise ConfigError(
            f"drones communicate what they measure with env.sensing=onboard, not {env.sensing}; set "
            "env.communication=none, or env.sensing=onboard"
        )
    if (seconds := env.communication_delay / env.policy_hz) > MAX_AGE:
        raise ConfigError(
            f"env.communication_delay={env.communication_delay} is {seconds:g} s, but nothing older than {MAX_AGE} s "
            "is used; lower it, or set env.communication=none"
        )


def make_links(config: EnvConfig, azimuth: np.ndarray) -> Links:
    """Return the links of a team whose slots are at these azimuths (N,) [rad]; neighbours are adjacent."""
    n = len(azimuth)
    partners = ~np.eye(n, dtype=bool)
    if config.communication == "neighbours":
        # The rank of each azimuth around the team; |gap| = N - 1 are the last and the first, who are neighbours, too.
        place = np.argsort(np.argsort(azimuth, kind="stable"))
        gap = np.abs(place[:, None] - place)
        partners &= (gap == 1) | (gap == n - 1)
    most = np.inf if config.communication_range is None else config.communication_range
    return Links(partners, config.communication_delay, config.communication_loss, most)


def make_messages(e: int, n: int, delay: int) -> Messages:
    """Return the messages of E teams of N drones, empty."""
    k = delay + 1
    return Messages(
        np.zeros(e, np.uint64), np.zeros(e, np.int64), np.zeros((e, k, n, 3)), np.zeros((e, k, n), bool),
        np.zeros((e, n, n, 3)), np.full((e, n, n), NEVER),
    )  # fmt: skip


def clear_messages(env: int, messages: Messages, seed: np.random.SeedSequence) -> None:
    """Begin an episode of one environment: nothing has been sent."""
    messages.generator[env] = seed.generate_state(1, np.uint64)[0]
    messages.steps[env] = 0
    messages.has_sent[env] = False
    messages.age[env] = NEVER


@kernel
def exchange_messages(lo, hi, broadcast, links, messages, first):
    """Send and hear the messages of a step in environments lo to hi.

    At the start of an episode drones know what those in range have to send.

    Args:
        lo, hi: the environments.
        broadcast: Broadcast of this step.
        links: Links.
        messages: Messages, advanced.
        first: whether an episode begins.
    """
    position, content, count = broadcast.position, broadcast.content, broadcast.position.shape[1]
    for e in range(lo, hi):
        now, kept = messages.steps[e], messages.sent.shape[1]
        for n in range(count):
            put(messages.sent[e, now % kept, n], vec(content, e, n))
            messages.has_sent[e, now % kept, n] = broadcast.has_message[e, n]
        then = now - links.delay
        for n in range(count):
            for m in range(count):
                if not links.partners[n, m]:
                    continue
                # Not beyond NEVER, or long episodes would overflow.
                messages.age[e, n, m] = min(messages.age[e, n, m] + 1, NEVER)
                arrives = uniform(e, messages) > links.loss  # drawn in any case: the draws of others stay the same
                # By the true positions, whatever the drones believe: radio does not ask.
                near = norm(sub(vec(position, e, n), vec(position, e, m))) <= links.range
                if first and near and broadcast.has_message[e, m]:
                    put(messages.heard[e, n, m], vec(content, e, m))
                    messages.age[e, n, m] = 0
                elif arrives and near and then >= 0 and messages.has_sent[e, then % kept, m]:
                    put(messages.heard[e, n, m], vec(messages.sent[e], then % kept, m))
                    messages.age[e, n, m] = links.delay
        messages.steps[e] = now + 1


@kernel
def update_shared_estimate(lo, hi, scene, messages, load, first):
    """Estimate each payload from all anchors that a drone knows, its own and those it has heard of.

    The planned attitude counts as a measurement, too, so that any number of anchors will do. Before there is one, a
    drone takes the payload to be where it is planned to be.
    """
    known = scene.memory.known
    for e in range(lo, hi):
        for n in range(load.tension.shape[1]):
            position, attitude, count = _fit(e, n, scene, messages)
            begins = first or not known[e, n]
            known[e, n] = count > 0 or not begins
            if not known[e, n]:
                assume_planned(e, n, scene.planned, load)
                continue
            if count == 0:
                predict_position(e, n, load, scene.sensor)
                continue
            follow_position(e, n, position, vec(scene.own.drone_velocity, e, n), load, scene.sensor, begins)
            follow_attitude(e, n, attitude, (0.0, 0.0, 0.0), load, scene.sensor, begins)


@kernel
def _fit(e, n, scene, messages):
    """Return position and attitude of the payload as drone n knows it, and how many anchors it knows."""
    anchors, attitude, team = scene.rig.anchors, matrow(scene.planned.rotation, e), scene.anchor.shape[1]
    # The mean of the known anchors, in the world and in the payload.
    mean, arm, count = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0
    for m in range(team):
        known, place = _known_anchor(e, n, m, scene, messages)
        if known:
            mean, arm, count = add(mean, place), add(arm, row(anchors, m)), count + 1
    if count == 0:
        return mean, attitude, 0
    mean, arm = scale(1.0 / count, mean), scale(1.0 / count, arm)

    # Least squares of the turn θ from the planned attitude, Gauss-Newton with b an anchor's arm about the mean:
    # (Σ (b² I - b bᵀ) + λ I) θ = Σ b × (place - mean) - λ (turn so far).
    turned, weight = (0.0, 0.0, 0.0), ATTITUDE_PRIOR**2
    for _ in range(3):
        # The prior draws back to the planned attitude. Two anchors leave the turn about their line to it, one all of
        # it.
        moment = scale(-weight, turned)
        x, y, z = (weight, 0.0, 0.0), (0.0, weight, 0.0), (0.0, 0.0, weight)
        for m in range(team):
            known, place = _known_anchor(e, n, m, scene, messages)
            if known:
                b = mul(attitude, sub(row(anchors, m), arm))
                moment = add(moment, cross(b, sub(place, mean)))
                square = dot(b, b)
                x = add(x, sub((square, 0.0, 0.0), scale(b[0], b)))
                y = add(y, sub((0.0, square, 0.0), scale(b[1], b)))
                z = add(z, sub((0.0, 0.0, square), scale(b[2], b)))
        inverse = 1.0 / dot(x, cross(y, z))  # Cramer's rule; the matrix is symmetric
        step = scale(inverse, (dot(moment, cross(y, z)), dot(moment, cross(z, x)), dot(moment, cross(x, y))))
        attitude = turn_by(step, attitude)
        turned = rotation_vector(matmul(attitude, transpose(matrow(scene.planned.rotation, e))))
    return sub(mean, mul(attitude, arm)), attitude, count


@kernel
def _known_anchor(e, n, m, scene, messages):
    """Return whether drone n knows where drone m's cable ends, and that place [m] now."""
    if n == m:
        return scene.knows_anchor[e, n], vec(scene.anchor, e, n)
    age = scene.sensor.dt * messages.age[e, n, m]
    # At the own drone's velocity: the filter's would feed the fit back into itself, and late news make that unstable.
    return age <= MAX_AGE, add(vec(messages.heard[e], n, m), scale(age, vec(scene.own.drone_velocity, e, n)))
