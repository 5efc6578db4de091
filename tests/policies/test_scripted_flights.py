"""Whole episodes of hover flown by scripts."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import OFF_CENTRE, make, zeros

from multilift_marl.envs.core import MultiliftVec
from multilift_marl.policies.baselines import make_scripted


def fly_once(vec: MultiliftVec, act, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return (E,) return, success and failure of one episode in every environment flown by act(observation)."""
    observation, _ = vec.reset(seed=seed)
    total, success, failure, over = np.zeros((4, vec.num_envs))
    over = over.astype(bool)
    for _ in range(vec.max_steps):
        observation, reward, terminated, truncated, info = vec.step(np.asarray(act(observation), float))
        total += np.where(over, 0, reward.mean(axis=1))
        success[~over], failure[~over] = info["success"][~over], terminated[~over]
        over |= terminated | truncated
        if over.all():
            break
        if (terminated | truncated).any():
            vec.reset(mask=terminated | truncated)
    assert over.all()
    return total, success.astype(bool), failure.astype(bool)


@pytest.mark.slow
def test_in_return_motors_off_lose_to_holding_the_start_to_the_formation_to_its_integral():
    def score(script=None, **gains):
        vec = make("hover", num_envs=64)
        vec.controller.gains = vec.controller.gains._replace(**gains)
        vec._bind()
        first, _ = vec.reset(seed=0)
        at = vec.observation_names.index("slot_error_0")
        hold = zeros(vec)
        hold[..., :3] = np.clip(first[..., at : at + 3] / vec.config.control.max_offset, -1, 1)
        total, *_ = fly_once(vec, make_scripted(script, vec).act if script else lambda observation: hold)
        return total

    off = score(thrust_min=np.zeros(4), thrust_max=np.zeros(4))
    hold, formation, integral = score(), score("formation"), score("formation_integral")
    assert off.mean() < 0.1 * hold.mean()
    assert hold.mean() < 0.8 * formation.mean()
    assert formation.mean() < 0.95 * integral.mean()
    assert (formation > hold).mean() > 0.8 and (integral > formation).mean() > 0.8


@pytest.mark.slow
@pytest.mark.parametrize("shape", ["box", "point"])
@pytest.mark.parametrize("num_drones", [1, 2, 3, 6, 16])
def test_the_formation_flies_any_number_of_drones(num_drones, cables, shape):
    vec = make("hover", num_envs=8, num_drones=num_drones, **{"payload.shape": shape}, **cables)
    _, _, failure = fly_once(vec, make_scripted("formation", vec).act)
    assert not failure.any()


@pytest.mark.slow
@pytest.mark.parametrize(
    "num_drones, overrides",
    [(4, {}), (3, {"payload.shape": "point"}), (4, {"payload.shape": "point"}), (4, {"payload.anchors": OFF_CENTRE})],
    ids=["box", "point 3", "point 4", "off-centre anchors"],
)
def test_the_integral_formation_succeeds_with_any_payload(num_drones, cables, overrides):
    vec = make("hover", num_envs=32, num_drones=num_drones, **overrides, **cables)
    _, success, failure = fly_once(vec, make_scripted("formation_integral", vec).act)
    assert not failure.any()
    assert success.mean() >= 0.9
