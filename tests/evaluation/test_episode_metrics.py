"""Metrics of episodes against loops over what happened: at the first step, at the last, and in between."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from plain_kernels import turned

from multilift_marl.evaluation.rollout import measure_episodes, trace_episode
from multilift_marl.tasks.base import FINAL_SECONDS

DT, STEPS = 0.02, 150
AXES = ("x_m", "y_m", "z_m", "roll_deg", "pitch_deg", "yaw_deg")


class FilmTask(SimpleNamespace):
    """What is read of a task."""

    def succeeded(self):
        raise AssertionError("Film says which episodes succeed")

    def criteria(self):
        return ()

    def metrics(self):
        return {}

    def success_windows(self):
        return ()


class Film:
    """Environments in which all happens as it was drawn before; episode e fails in step `fails[e]`, 0: never."""

    num_drones, action_size, failure_causes = 2, 3, ("none",)
    config, commander = SimpleNamespace(control=SimpleNamespace(action="reference")), None

    def __init__(self, fails, seed: int = 0, steps: int = STEPS, rmse_after: float = 0.5):
        self.num_envs, self.max_steps, self.fails = len(fails), steps, np.array(fails)
        self.rng, e = np.random.default_rng(seed), len(fails)
        self.at, self.steps = 0, np.zeros(e, int)
        self.position = self.rng.normal(size=(steps, e, 3)) * np.geomspace(0.3, 0.02, steps)[:, None, None]
        self.rotation = 0.1 * self.rng.normal(size=(steps, e, 3))
        self.reward = self.rng.normal(size=(steps, e, 2))
        self.actions = 1.5 * self.rng.normal(size=(steps, e, 2, 3))
        self.yaw, self.tilts = self.rng.uniform(-3, 3, e), 0.3 * self.rng.random((steps, e))
        self.stats = self.rng.random((5, steps, e))
        goal = SimpleNamespace(yaw=self.yaw, position=np.zeros((e, 3)))
        self.task = FilmTask(name="film", dt=DT, rmse_after=rmse_after, goal=goal, in_error_window=self.late)
        self.world = SimpleNamespace()
        self.show(0)

    def late(self, time, length):
        return time > length - FINAL_SECONDS + 1e-9

    def show(self, step: int) -> None:
        position, rotation = self.position[step], self.rotation[step]
        self.task.errors = SimpleNamespace(
            position=position, rotation=rotation, distance=np.linalg.norm(position, axis=1),
            angle=np.linalg.norm(rotation, axis=1),
        )  # fmt: skip
        low, peak, slack, energy, self.task.min_separation = self.stats[:, step]
        self.world.stats = SimpleNamespace(tension_min=low, tension_peak=peak, slack_time=slack, energy=energy)
        attitudes = np.stack([turned([1.0, 0.0, 0.0], tilt) for tilt in self.tilts[step]])
        self.world.state = SimpleNamespace(payload_rotation=attitudes)

    def step(self, action):
        self.show(self.at)
        self.at += 1
        self.steps += 1
        terminated = self.steps == self.fails
        truncated = (self.steps >= self.max_steps) & ~terminated
        cause = np.where(terminated, 3, 0)
        info = {"success": truncated & (np.arange(self.num_envs) % 2 == 0), "failure_cause": cause}
        return np.zeros((self.num_envs, 2, 1)), self.reward[self.at - 1], terminated, truncated, info

    def reset(self, mask):
        self.steps[mask] = 0
        return np.zeros((self.num_envs, 2, 1)), {}


class Actor:
    """Acts as drawn."""

    def __init__(self, film):
        self.film = film

    def reset(self, mask=None):
        pass

    def act(self, observation):
        return self.film.actions[self.film.at]


FAILS = (0, 1, 2, 60, STEPS - 1, STEPS, 0)


@pytest.mark.parametrize("steps, rmse_after", [(STEPS, 0.5), (STEPS, 0.0), (1, 0.0), (2, 0.0)])
def test_metrics_are_those_of_each_episode_up_to_its_own_end(steps, rmse_after):
    film = Film([min(step, steps) if step != STEPS - 1 else 0 for step in FAILS], steps=steps, rmse_after=rmse_after)
    if steps == STEPS:
        film = Film(FAILS, rmse_after=rmse_after)
    found = measure_episodes(film, Actor(film), np.zeros((film.num_envs, 2, 1)))
    for e, fails in enumerate(film.fails):
        length, failed = (int(fails), True) if fails else (steps, False)
        span = slice(0, length)
        distance = np.linalg.norm(film.position[span, e], axis=1)
        clipped = np.clip(film.actions[span, e], -1, 1)
        change = np.diff(clipped, axis=0, prepend=np.zeros((1, 2, 3)))
        assert found["return"][e] == pytest.approx(film.reward[span, e].mean(axis=1).sum(), rel=1e-12)
        assert found["action_rate"][e] == pytest.approx(np.sqrt((change**2).mean()), rel=1e-12)
        assert found["success_rate"][e] == (not failed and e % 2 == 0)
        assert found["failure_cause"][e] == (3 if failed else 0)
        for row, name in enumerate(("cable_tension_min_n", "cable_tension_max_n", "slack_time_s", "energy_j")):
            assert found[name][e] == film.stats[row, length - 1, e]
        assert found["min_separation_m"][e] == film.stats[4, length - 1, e]
        if failed:
            assert found["settling_time_s"][e] == steps * DT and not found["precise_rate"][e]
            assert found["payload_position_error_m"][e] == found["payload_rmse_m"][e] == 3.0
            assert found["payload_attitude_error_deg"][e] == found["payload_tilt_deg"][e] == 180.0
            assert [found[f"payload_rmse_{axis}"][e] for axis in AXES] == [3.0] * 3 + [180.0] * 3
            continue
        outside = np.flatnonzero(distance > 0.05)
        assert found["settling_time_s"][e] == pytest.approx((outside[-1] + 1) * DT if outside.size else 0.0)
        time = DT * np.arange(1, length + 1)
        late, counted = time > steps * DT - FINAL_SECONDS + 1e-9, time > rmse_after
        angle = np.degrees(np.linalg.norm(film.rotation[span, e], axis=1))
        assert found["payload_position_error_m"][e] == pytest.approx(distance[late].mean(), rel=1e-12)
        assert found["payload_attitude_error_deg"][e] == pytest.approx(angle[late].mean(), rel=1e-12)
        assert found["payload_tilt_deg"][e] == pytest.approx(np.degrees(film.tilts[span, e])[late].mean(), rel=1e-6)
        assert found["payload_rmse_m"][e] == pytest.approx(np.sqrt((distance[counted] ** 2).mean()), rel=1e-12)
        back = turned([0, 0, 1], -film.yaw[e])  # into the frame of the target's heading
        parts = [film.position[span, e] @ back.T, np.degrees(film.rotation[span, e]) @ back.T]
        rms = np.concatenate([np.sqrt((part[counted] ** 2).mean(axis=0)) for part in parts])
        np.testing.assert_allclose([found[f"payload_rmse_{axis}"][e] for axis in AXES], rms, rtol=1e-9)


@pytest.mark.parametrize("distance, angle, precise", [(0.0099, 0.99, 1), (0.0101, 0.9, 0), (0.009, 1.01, 0)])
def test_an_episode_is_precise_within_a_centimetre_and_a_degree(distance, angle, precise):
    film = Film([0])
    film.position[:] = distance * np.array([0.6, 0.0, 0.8])
    film.rotation[:] = np.radians(angle) * np.array([0.0, 0.6, 0.8])
    assert measure_episodes(film, Actor(film), np.zeros((1, 2, 1)))["precise_rate"][0] == precise


@pytest.mark.parametrize("distance, settled", [(0.0499, 0.0), (0.0501, STEPS * DT)])
def test_a_payload_is_settled_within_five_centimetres(distance, settled):
    film = Film([0])
    film.position[:] = [distance, 0.0, 0.0]
    assert measure_episodes(film, Actor(film), np.zeros((1, 2, 1)))["settling_time_s"][0] == pytest.approx(settled)


@pytest.mark.parametrize("seconds, failing", [(0.02, False), (0.1, False), (0.1, True)])
def test_a_trace_ends_with_its_episode(seconds, failing):
    from multilift_marl.config.load import load_config
    from multilift_marl.policies.baselines import make_scripted

    config = load_config("hover", {"env.episode_seconds": seconds, "env.num_threads": 1, "env.num_drones": 2})
    seen = []

    def on_step(vec):
        seen.append(vec.steps[0])
        if failing and len(seen) == 3:
            vec.world.hidden_loads.payload_force[0] = 1e9  # it diverges in the third step, of which the start is none

    trace = trace_episode(config, lambda vec: make_scripted("formation", vec), 0, 1, on_step)
    count = 3 if failing else round(seconds / 0.02)
    assert seen == list(range(count + 1))
    np.testing.assert_allclose(trace.time, 0.02 * np.arange(1, count + 1))
    assert len(trace.distance) == len(trace.tension) == count
