"""Cable forces after a loss: balance, limits, and a team that flies by them."""

from functools import partial

import numpy as np
import pytest
from conftest import GRAVITY, make, refusal

from multilift_marl.config.load import load_config
from multilift_marl.control.gains import make_gains
from multilift_marl.control.redistribution import redistribute
from multilift_marl.control.scripted import fitting_scripts, make_scripted
from multilift_marl.evaluation.rollout import fly_episodes


def solve(name: str, lost: int = 0, thrust_share: float = 0.8, max_offset: float = 1.0, hangs: bool = True):
    config = load_config(name)
    system, gains = config.system, make_gains(config.control, config.system)
    return system, redistribute(system, gains, lost, hangs, thrust_share, max_offset)


@pytest.mark.parametrize("name", ["loss", "loss_6"])
@pytest.mark.parametrize("hangs", [True, False])
def test_the_remaining_cables_carry_the_weights(name, hangs):
    for lost in range(load_config(name).env.num_drones):
        system, found = solve(name, lost, hangs=hangs)
        carried = GRAVITY * (system.payload_mass + hangs * system.drone_mass[lost])
        np.testing.assert_allclose(found.force.sum(axis=0), [0, 0, carried], atol=1e-6)
        assert not found.force[lost].any() and not found.offset[lost].any()
        lifted = found.force + GRAVITY * system.drone_mass[:, None] * [0, 0, 1]
        share = np.linalg.norm(lifted, axis=1) / 20.0
        np.testing.assert_allclose(np.delete(found.thrust, lost), np.delete(share, lost), rtol=2e-3)
        assert found.thrust.max() <= 0.8 and np.abs(found.offset).max() <= 1.0


def test_six_drones_lose_one_and_stay_level_while_four_cannot():
    tilts = {name: np.rad2deg(solve(name)[1].tilt) for name in ("loss", "loss_6")}
    assert tilts["loss_6"] <= 1.5 and 35 < tilts["loss"] < 45
    assert np.rad2deg(solve("loss", hangs=False)[1].tilt) <= 5


def test_less_thrust_or_room_means_more_tilt():
    free, weak, near = (
        solve("loss", **options)[1].tilt for options in ({}, {"thrust_share": 0.72}, {"max_offset": 0.6})
    )
    assert free < min(weak, near)
    assert solve("loss", thrust_share=0.4)[1] is None


@pytest.mark.parametrize(("name", "angle"), [("loss", 40.0), ("loss_6", 1.5), ("loss_snap", 5.0)])
def test_a_team_that_redistributes_comes_to_rest_as_computed(name, angle):
    script = partial(make_scripted, "formation_redistributed")
    flown = fly_episodes(load_config(name), script, 16, seed=3)
    assert flown["success_rate"].mean() >= 0.9
    assert np.median(flown["payload_position_error_m"]) < 0.03
    assert np.median(flown["payload_attitude_error_deg"]) < angle


def test_the_script_needs_to_know_who_is_lost():
    assert "formation_redistributed" in fitting_scripts(make("loss", num_envs=1))
    assert "formation_redistributed" not in fitting_scripts(make("gate", num_envs=1))
    message = refusal(make_scripted, "formation_redistributed", make("hover", num_envs=1))
    assert message.startswith("formation_redistributed is for the loss of a drone, and task hover tells of none")
