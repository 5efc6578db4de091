"""Environments in which a trained policy's numbers mean something else than in its own: which are warned of."""

from __future__ import annotations

import logging

import pytest

import multilift_marl as ml
from multilift_marl.agents.meanings import changed_meanings
from multilift_marl.config.load import build_config
from multilift_marl.errors import warn_once


@pytest.mark.parametrize(
    "action, overrides, changed",
    [
        ("reference", {"control.max_offset": 0.1, "control.max_velocity": 3.0}, ["control.max_offset"]),
        ("reference", {"env.policy_hz": 25.0, "control.max_yaw": 0.2}, ["control.max_yaw", "env.policy_hz"]),
        ("ctbr", {"control.max_offset": 0.1, "control.max_tilt_rate": 8.0}, ["control.max_tilt_rate"]),
        ("rotor", {"control.max_offset": 0.1, "sim.timestep": 0.002, "sim.control_hz": 500}, []),
        ("acc_rates", {"planner.position": 0.2}, []),
        ("planner_weights", {"control.max_weight": 50.0}, ["control.max_weight"]),
        ("planner_weights", {"planner.position": 0.2, "planner.steps": 10}, ["planner.steps", "planner.position"]),
        ("planner_weights", {"planner.limits": "hard", "planner.lead": 0.1}, ["planner.limits", "planner.lead"]),
        ("planner_weights", {"planner.deadline": 0.1, "planner.patience": 1.0, "planner.distributed": True}, []),
        ("planner_weights", {"planner.sweeps": 5, "control.max_offset": 0.1}, []),
        ("reference", {"env.num_drones": 6, "payload.mass": 2.0, "randomization.payload_mass": 0.3}, []),
    ],
)
def test_full_scales_of_its_own_interface_and_the_rate_count(action, overrides, changed):
    there = ml.load_config("hover", {"control.action": action})
    assert changed_meanings(there, build_config(there.model_dump(), overrides)) == changed


def test_in_units_of_the_cables_the_rate_is_one_of_the_rig():
    there = ml.load_config("hover", {"env.units": "cable"})
    assert changed_meanings(there, build_config(there.model_dump(), {"env.policy_hz": 25.0})) == []


@pytest.mark.parametrize("key, own, other", [("control.max_offset", 0.5, 0.1), ("env.policy_hz", 50.0, 25.0)])
def test_evaluation_warns_of_them(key, own, other, caplog):
    policy = ml.load_policy("hover")
    warn_once.cache_clear()
    with caplog.at_level(logging.WARNING):
        policy.check(build_config(policy.config.model_dump(), {"payload.mass": 2.0}))
        assert not caplog.records
        policy.check(build_config(policy.config.model_dump(), {key: other}))
    assert [f"was configured with {key}={own}; " in record.message for record in caplog.records] == [True]
