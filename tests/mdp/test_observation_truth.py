"""Every number of an observation against the true state: docs/tasks.md and docs/<task>.md, written anew in NumPy."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from conftest import TASKS, make, zeros

from multilift_marl.control.gains import make_gains
from multilift_marl.control.redistribution import redistributed_slots
from multilift_marl.envs.core import MultiliftVec
from multilift_marl.mdp.observations import list_components

STEPS = {"takeoff": 215, "land": 440, "pose": 70, "track": 65}  # that something happens in; else 25
COMPARED = 25  # moments of each flight
AHEAD = 40  # [steps] that a component of `track` looks ahead
INTEGRAL = 0.5  # [m s], [rad s] limit of the error integrals
NEAR = {"task_options.target_xy": 0.1, "task_options.target_height": [1.4, 1.6], "task_options.target_yaw": 20.0}
SETTINGS: dict[str, dict[str, Any]] = {
    "pose": {
        "task_options.target_seconds": 1.2,
        "task_options.way_seconds": 1.0,
        "task_options.target_tilt": 10.0,
        **NEAR,
    },
    "track": {"task_options.path": "random"},
    "takeoff": {"control.max_offset": 0.01},
    "navigate": {"env.obstacle_sensing": "none"},
    "land": {"control.max_offset": 0.01},
    "loss": {"task_options.loss_time": [0.2, 0.3], "task_options.broadcast": True},
    "regroup": {"task_options.events": [0.1], "task_options.event_spread": 0.05, "task_options.success_seconds": 0.1},
}


def heading(rotation: np.ndarray) -> np.ndarray:
    """Return the heading atan2(-R01, R11) of attitudes (..., 3, 3) [rad]."""
    return np.arctan2(-rotation[..., 0, 1], rotation[..., 1, 1])


def turned(angle: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Return vectors (..., 3) of the world in a frame whose x axis has the heading `angle` (...) [rad]."""
    x, y, z = np.moveaxis(vector, -1, 0)
    c, s = np.cos(angle), np.sin(angle)
    return np.stack([c * x + s * y, c * y - s * x, z], axis=-1)


def rotation_vector(rotation: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Return rotation vectors (E, 3) from target attitudes to attitudes, (E, 3, 3) each [rad]."""
    between = rotation @ np.swapaxes(target, -1, -2)
    skew = 0.5 * (between - np.swapaxes(between, -1, -2))  # of the axis, times the sine of the angle
    axis = np.stack([skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]], axis=-1)
    sine = np.linalg.norm(axis, axis=-1, keepdims=True)
    angle = np.arctan2(sine, 0.5 * (np.trace(between, axis1=-2, axis2=-1)[..., None] - 1))
    return axis * np.where(sine > 1e-9, angle / np.maximum(sine, 1e-9), 1.0)


class Moment:
    """Copies of all that an observation of one moment may tell, and of the errors' integrals so far.

    Attributes:
        state, goal, way, reference: by name, environment first.
        action: last one (E, N, A).
        integrals: of position and rotation errors (E, 3).
        observation: what the drones are told (E, N, D).
    """

    def __init__(self, vec: MultiliftVec, observation: np.ndarray, action: np.ndarray, before: Moment | None):
        task, world = vec.task, vec.world
        self.vec, self.observation, self.action = vec, observation, action
        self.state = {name: array.copy() for name, array in world.state._asdict().items()}
        self.goal = {name: array.copy() for name, array in task.goal._asdict().items()}
        self.planned = {name: array.copy() for name, array in task.planned._asdict().items()}
        self.reference = {name: array.copy() for name, array in vec.reference._asdict().items()}
        self.lost = world.hidden_loads.motors_off.copy()
        self.seconds = 0.0 if before is None else before.seconds + task.dt
        apart = (
            self.state["payload_position"] - self.planned["position"],
            rotation_vector(self.state["payload_rotation"], self.planned["rotation"]),
        )
        self.integrals = [np.zeros_like(error) for error in apart]
        if before is not None:
            self.integrals = [
                np.clip(old + task.dt * error, -INTEGRAL, INTEGRAL)
                for old, error in zip(before.integrals, apart, strict=True)
            ]
        slots = world.system.slots
        self.azimuth = np.arctan2(slots[:, 1], slots[:, 0])
        self.frame = heading(self.goal["rotation"])[:, None] + self.azimuth  # (E, N) headings of the slot frames

    def in_slot_frame(self, vector: np.ndarray) -> np.ndarray:
        """Return a vector of each drone (E, N, 3), or of the team (E, 3), in the slot frames (E, N, 3)."""
        vector = vector[:, None] if vector.ndim == 2 else vector
        return turned(self.frame, np.broadcast_to(vector, (*self.frame.shape, 3)).copy())

    def anchors(self) -> np.ndarray:
        """Return the attachments of the cables on the payload (E, N, 3) [m]."""
        return self.state["payload_position"][:, None] + np.einsum(
            "eij,nj->eni", self.state["payload_rotation"], self.vec.world.system.anchors
        )

    def hooks(self) -> np.ndarray:
        """Return the ends of the cables at the drones (E, N, 3) [m]."""
        system = self.vec.world.system
        return self.state["drone_position"] + np.einsum("enij,nj->eni", self.state["drone_rotation"], system.hooks)


def pair(angle: np.ndarray) -> np.ndarray:
    """Return cosine and sine (..., 2)."""
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def common(m: Moment) -> dict[str, np.ndarray]:
    """Return the components of all tasks, (E, N, size) each."""
    state, goal, system = m.state, m.goal, m.vec.world.system
    spin = np.einsum("eij,ej->ei", state["payload_rotation"], state["payload_body_rates"])
    at_target = goal["position"][:, None] + np.einsum("eij,nj->eni", goal["rotation"], system.anchors)
    own_heading = heading(state["drone_rotation"]) - heading(goal["rotation"])[:, None]
    in_slot_frame = m.in_slot_frame
    return {
        "slot_error": in_slot_frame(state["drone_position"] - goal["slots"]),
        "velocity": in_slot_frame(state["drone_velocity"]),
        "thrust_axis": in_slot_frame(state["drone_rotation"][..., 2]),
        "heading": pair(own_heading),
        "body_rates": state["drone_body_rates"],
        "tracking_error": in_slot_frame(state["drone_position"] - m.reference["position"]),
        "reference_velocity": in_slot_frame(m.reference["velocity"]),
        "anchor_error": in_slot_frame(m.anchors() - at_target),
        "cable": in_slot_frame((m.hooks() - m.anchors()) / system.cable_length[:, None]),
        "payload_error": in_slot_frame(state["payload_position"] - goal["position"]),
        "payload_velocity": in_slot_frame(state["payload_velocity"]),
        "payload_rotation_error": in_slot_frame(rotation_vector(state["payload_rotation"], goal["rotation"])),
        "payload_angular_velocity": in_slot_frame(spin),
        "payload_error_integral": in_slot_frame(m.integrals[0]),
        "rotation_error_integral": in_slot_frame(m.integrals[1]),
        "slot_direction": np.broadcast_to(pair(m.azimuth), (*m.frame.shape, 2)),
        "previous_action": m.action,
    }


def everyone(m: Moment, value: np.ndarray | float) -> np.ndarray:
    """Return a number of each environment (E,), or of all, for every drone (E, N, 1)."""
    return np.broadcast_to(np.reshape(value, (-1, 1, 1)), (*m.frame.shape, 1))


def eased(m: Moment, begin: float, end: float) -> float:
    """Return the share done of what goes from `begin` to `end` [s] by the polynomial of degree seven, smooth thrice."""
    s = np.clip((m.seconds - begin) / (end - begin), 0, 1)
    return float(np.polyval([-20, 70, -84, 35, 0, 0, 0, 0], s))


def gate(m: Moment, later: list[Moment]) -> dict[str, np.ndarray]:
    """See docs/gate.md: one wall at x = 0, its gap 1 m wide; the drone's box must pass between the edges."""
    task, position = m.vec.task, m.state["drone_position"]
    x, middle, half = position[..., 0], task.own.gap_y, task.limits.drone_half[0]
    before = x < 0.05 + np.hypot(half[0], half[1]) + 0.05
    room = 0.5 - np.abs(position[..., 1] - middle) - np.abs(m.state["drone_rotation"][..., 1, :]) @ half
    lateral = np.zeros_like(position)
    lateral[..., 1] = np.where(before, position[..., 1] - middle, 0)
    return {
        "target_velocity": m.in_slot_frame(m.goal["velocity"])[..., :2],
        "gap": m.in_slot_frame(lateral)[..., :2],
        "gap_distance": x[..., None],
        "clearance": np.where(before, np.clip(room, -0.5, 0.5), 0.5)[..., None],
    }


def land(m: Moment, later: list[Moment]) -> dict[str, np.ndarray]:
    """See docs/land.md: the target is down after 6.4 s, then the pull fades until 8.6 s."""
    return {
        "time_to_touch": everyone(m, 6.4 - m.seconds),
        "pull_share": everyone(m, 1 - eased(m, 6.4, 8.6)),
        "target_velocity": m.in_slot_frame(m.goal["velocity"]),
    }


def loss(m: Moment, later: list[Moment]) -> dict[str, np.ndarray]:
    """See docs/loss.md: drones give way for 0.9 s; from 1 s on they move to where they hold the payload."""
    lost, who = m.lost.any(axis=1), m.lost.argmax(axis=1)
    between = m.azimuth[who][:, None] - m.azimuth
    since = (m.seconds - m.vec.task.own.when)[:, None, None]
    down = np.stack([0 * between + 0.2, 0 * between, -0.2 - 0.5 * np.cos(between)], axis=-1)
    share = np.clip((since - 1) / 3, 0, 1)
    config, system = m.vec.config.control, m.vec.world.system
    held = redistributed_slots(system, make_gains(config, system), True, config.max_offset)[who]
    plan = np.where(since < 0.9, down, 0.0) + held * (3 * share**2 - 2 * share**3)
    return {
        "planned_offset": np.where(lost[:, None, None], plan, 0.0),
        "lost": m.lost[..., None],
        "team_lost": everyone(m, lost),
        "lost_direction": np.where(lost[:, None, None], pair(between), 0.0),
    }


def navigate(m: Moment, later: list[Moment]) -> dict[str, np.ndarray]:
    """See docs/navigate.md: the target moves straight to the goal."""
    return {
        "to_goal": m.in_slot_frame(m.vec.task.own.goal - m.goal["position"]),
        "target_velocity": m.in_slot_frame(m.goal["velocity"]),
    }


def pose(m: Moment, later: list[Moment]) -> dict[str, np.ndarray]:
    """See docs/pose.md."""
    each = m.vec.task.options.target_seconds
    return {
        "planned_position": m.in_slot_frame(m.planned["position"] - m.goal["position"]),
        "planned_velocity": m.in_slot_frame(m.planned["velocity"]),
        "planned_rotation": m.in_slot_frame(rotation_vector(m.planned["rotation"], m.goal["rotation"])),
        "time_left": everyone(m, 1 - ((m.seconds + 1e-9) % each) / each),
    }


def recover(m: Moment, later: list[Moment]) -> dict[str, np.ndarray]:
    """See docs/recover.md."""
    length = m.vec.world.system.cable_length
    spanned = np.linalg.norm(m.hooks() - m.anchors(), axis=-1)
    return {"grace": everyone(m, 1 - m.seconds / 2.0), "slack": ((length - spanned) / length)[..., None]}


def regroup(m: Moment, later: list[Moment]) -> dict[str, np.ndarray]:
    """See docs/regroup.md."""
    return {"attached": ~m.state["cable_broken"][..., None]}


def takeoff(m: Moment, later: list[Moment]) -> dict[str, np.ndarray]:
    """See docs/takeoff.md: the pull grows from 2.9 to 4.1 s, then the target leaves the ground."""
    climb = m.goal["velocity"][:, 2]
    return {
        "time_to_lift": everyone(m, max(4.1 - m.seconds, -4.0)),
        "pull_share": everyone(m, eased(m, 2.9, 4.1)),
        "climb_rate": everyone(m, climb),
    }


def track(m: Moment, later: list[Moment]) -> dict[str, np.ndarray]:
    """See docs/track.md; what the target does next is what it has done when the time has come."""
    ahead = {
        f"target_ahead_{ms}ms": m.in_slot_frame(later[round(0.05 * ms) - 1].goal["position"] - m.goal["position"])
        for ms in (100, 200, 400, 800)
    }
    return {
        "target_velocity": m.in_slot_frame(m.goal["velocity"]),
        "target_acceleration": m.in_slot_frame(m.goal["acceleration"]),
        **ahead,
    }


OWN: dict[str, Callable[[Moment, list[Moment]], dict[str, np.ndarray]]] = {
    "gate": gate, "hover": lambda m, later: {}, "land": land, "loss": loss, "navigate": navigate,
    "pose": pose, "recover": recover, "regroup": regroup, "takeoff": takeoff, "track": track,
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("task", TASKS)
def test_every_number_of_an_observation_is_what_the_documents_say(task):
    hooks = {"cable.hook": [0.01, -0.005, -0.03]}
    vec = make(task, num_envs=3, num_drones=4, **hooks, **SETTINGS.get(task, {}))
    observation, _ = vec.reset(seed=3)
    rng, moments = np.random.default_rng(0), [Moment(vec, observation.astype(float), zeros(vec), None)]
    for _ in range(STEPS.get(task, COMPARED)):
        action = 0.3 * rng.uniform(-1, 1, moments[0].action.shape)
        observation, _, terminated, truncated, _ = vec.step(action)
        assert not (terminated | truncated).any()
        moments.append(Moment(vec, observation.astype(float), action, moments[-1]))
    components = list_components(vec.config.control.action, vec.task.EXTRA)
    compared = len(moments) - (AHEAD if task == "track" else 0)
    for k in np.linspace(0, compared - 1, COMPARED).astype(int).tolist():
        expected = common(moments[k]) | OWN[task](moments[k], moments[k + 1 :])
        assert set(expected) == {part.name for part in components}
        at = 0
        for part in components:
            seen, at = moments[k].observation[..., at : at + part.size], at + part.size
            np.testing.assert_allclose(
                seen, expected[part.name], rtol=1e-5, atol=2e-5, err_msg=f"{part.name}, step {k}"
            )
        assert at == vec.observation_size


def test_the_global_state_holds_what_an_episode_hides():
    ranges = {
        "payload_inertia": 0.2, "payload_center_of_mass": [0.01, 0.01, 0.01], "action_delay": [0, 3],
        "cable_length": 0.1, "vehicle_mass": 0.05, "vehicle_thrust_coefficient": 0.05,
        "vehicle_rotor_time_constant": 0.2, "rotor_thrust_coefficient": 0.05,
    }  # fmt: skip
    plain = make("hover", num_envs=3, num_drones=3)
    vec = make(
        "hover", num_envs=3, num_drones=3, **{f"randomization.{k}": v for k, v in ranges.items()},
        **{"wind.velocity": [3.0, 1.0, 0.0], "wind.turbulence": True},
    )  # fmt: skip
    _, info = vec.reset(seed=4)
    for _ in range(5):
        _, _, _, _, info = vec.step(zeros(vec))
    drawn, system, n = info["randomization"], vec.config.system, 3
    first, _, size = vec.task.drone_numbers
    state, action = vec.state(), vec.action_size
    assert vec.state_size == plain.state_size + n * 8 + 8
    of_drones = state[:, first : first + n * size].reshape(3, n, size)
    expected = np.stack(
        [
            drawn["cable_length"] / system.cable_length - 1, drawn["vehicle_mass"] / system.drone_mass - 1,
            drawn["vehicle_thrust_coefficient"] - 1, drawn["vehicle_rotor_time_constant"] - 1,
        ],
        axis=-1,
    )  # fmt: skip
    expected = np.concatenate([expected, drawn["rotor_thrust_coefficient"] - 1], axis=-1)
    np.testing.assert_allclose(of_drones[..., size - action - 8 : size - action], expected, atol=1e-6)
    assert (np.abs(expected).max(axis=(0, 1)) > 0.01).all()
    gust = turned(heading(vec.task.goal.rotation), vec.world.air.gust)
    rest = [
        drawn["payload_inertia"][:, None] - 1,
        drawn["payload_center_of_mass"],
        drawn["action_delay"][:, None],
        gust,
    ]
    np.testing.assert_allclose(state[:, -8:], np.concatenate(rest, axis=1), atol=1e-6)
    assert (np.abs(gust[:, :2]) > 1e-3).all()
