"""Cable forces after a loss: balance, limits, and a team that flies by them."""

from functools import partial

import numpy as np
import pytest
from conftest import GRAVITY, make, refusal

from multilift_marl.config.load import load_config
from multilift_marl.control.gains import make_gains
from multilift_marl.control.redistribution import plan_offset, redistribute
from multilift_marl.evaluation.rollout import run_episodes
from multilift_marl.policies.baselines import fitting_scripts, make_scripted


def solve(name: str, lost: int = 0, thrust_share: float = 0.8, max_offset: float = 1.0, hangs: bool = True, **keys):
    config = load_config(name, keys)
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


@pytest.mark.parametrize(("name", "hangs"), [("loss", True), ("loss_6", False)])
def test_hooks_end_up_where_cables_hold_the_payload(name, hangs):
    """A drone is above its hook, wherever that is: cable, hook and slot close the way from the anchor."""
    for hook in ([0.0, 0.0, 0.0], [0.03, -0.02, -0.05]):
        system, found = solve(name, hangs=hangs, **{"cable.hook": hook})
        gains, found_anchors = make_gains(load_config(name).control, system), []
        for n in range(1, system.num_drones):
            c, s = np.cos(system.slot_azimuth[n]), np.sin(system.slot_azimuth[n])
            slot = system.slots[n] + np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ found.offset[n]
            drone = slot - (found.force[n] - system.formation_force[n]) / (gains.mass[n] * gains.k_p[n])
            lifted = found.force[n] + GRAVITY * system.drone_mass[n] * np.array([0, 0, 1])
            z = lifted / np.linalg.norm(lifted)
            y = np.cross(z, [np.cos(system.heading[n]), np.sin(system.heading[n]), 0])
            y /= np.linalg.norm(y)
            cable = drone + np.column_stack([np.cross(y, z), y, z]) @ system.hooks[n]
            size = np.linalg.norm(found.force[n])
            cable -= found.force[n] / size * (system.cable_length[n] + size / system.cable_stiffness[n])
            found_anchors.append(cable)
        # However the payload is tilted, its anchors are as far from each other as they are.
        apart = [
            np.linalg.norm(each[:, None] - each, axis=-1) for each in (np.array(found_anchors), system.anchors[1:])
        ]
        np.testing.assert_allclose(*apart, atol=1e-3)


def test_less_thrust_or_room_means_more_tilt():
    free, weak, near = (
        solve("loss", **options)[1].tilt for options in ({}, {"thrust_share": 0.72}, {"max_offset": 0.6})
    )
    assert free < min(weak, near)
    assert solve("loss", thrust_share=0.4)[1] is None


@pytest.mark.slow
@pytest.mark.parametrize(("name", "angle"), [("loss", 40.0), ("loss_6", 1.5), ("loss_snap", 5.0)])
def test_a_team_that_redistributes_comes_to_rest_as_computed(name, angle):
    script = partial(make_scripted, "formation_redistributed")
    flown = run_episodes(load_config(name), script, 16, seed=3)
    assert flown["success_rate"].mean() >= 0.9
    assert np.median(flown["payload_position_error_m"]) < 0.03
    assert np.median(flown["payload_attitude_error_deg"]) < angle


def test_slots_give_way_to_the_falling_drone_then_go_where_they_hold_the_payload():
    held = np.array([0.3, -0.2, 0.6])
    assert plan_offset(0.5, held, 1.0, True) == pytest.approx((0.2, 0.0, -0.7))
    assert plan_offset(0.5, held, -1.0, True) == pytest.approx((0.2, 0.0, 0.3))
    assert plan_offset(0.5, held, 1.0, False) == plan_offset(0.95, held, 1.0, True) == (0, 0, 0)
    assert plan_offset(2.5, held, 1.0, True) == pytest.approx(held / 2)  # half of the way after half of the time
    assert plan_offset(4.0, held, 1.0, True) == plan_offset(99.0, held, -1.0, False) == pytest.approx(held)


@pytest.mark.slow
def test_drones_are_told_their_planned_offset():
    vec = make("loss_6", num_envs=8, num_drones=6, **{"task_options.loss_time": (0.5, 0.5)})
    told = vec.observation_names.index("planned_offset_0")
    team, (observation, _) = make_scripted("formation_redistributed", vec), vec.reset(seed=1)
    who = vec.task.own.who.copy()
    _, found = solve("loss_6")
    for step in range(1, 240):
        observation = vec.step(team.act(observation))[0]
        offset = observation[..., told : told + 3]
        if step < 25:
            assert not offset.any()
        elif step == 40:
            angle = vec.task.rig.azimuth[who][:, None] - vec.task.rig.azimuth
            np.testing.assert_allclose(offset[..., 2], -0.2 - 0.5 * np.cos(angle), atol=1e-6)
            np.testing.assert_allclose(offset[..., :2], [[[0.2, 0.0]] * 6] * 8, atol=1e-6)
    np.testing.assert_allclose(offset[who == 0], [found.offset] * (who == 0).sum(), atol=1e-6)
    assert (who == 0).any()


TOLD = {"task_options.broadcast": True}


@pytest.mark.parametrize("name", ["loss", "loss_6"])
def test_giving_way_halves_the_snatch(name):
    peaks = {}
    for script in ("formation_integral", "formation_redistributed"):
        vec = make(
            name, num_envs=16, num_drones=load_config(name).env.num_drones, **{"control.max_offset": 1.0, **TOLD}
        )
        team, (observation, _) = make_scripted(script, vec), vec.reset(seed=0)
        for _ in range(280):  # the last loss is at 4 s, its snatch 0.6 s later
            observation = vec.step(team.act(observation))[0]
        peaks[script] = np.median(vec.task.own.peak_tension)
    assert peaks["formation_redistributed"] < 0.6 * peaks["formation_integral"]
    assert peaks["formation_redistributed"] < vec.task.options.success_tension < peaks["formation_integral"]


def test_the_script_needs_to_know_who_is_lost():
    assert "formation_redistributed" in fitting_scripts(make("loss", num_envs=1))
    assert "formation_redistributed" not in fitting_scripts(make("gate", num_envs=1))
    message = refusal(make_scripted, "formation_redistributed", make("hover", num_envs=1))
    assert message.startswith("formation_redistributed is for the loss of a drone, and task hover has none")
