"""What the viewer flies and shows of what it is asked for: baselines by name, configurations with a rig."""

import pytest
from test_view import session

from multilift_marl.config.load import load_config


@pytest.mark.parametrize(
    "policy, values",
    [
        pytest.param("mpc", {"control.action": "acc_rates"}, marks=pytest.mark.slow),
        pytest.param("mpc_route", {"task": "navigate", "control.action": "acc_rates"}, marks=pytest.mark.slow),
        ("formation_route", {"task": "navigate"}),
        ("formation_balanced", {"task": "regroup"}),
    ],
)
def test_a_baseline_that_plans_or_knows_the_truth_flies_where_it_is_named(policy, values):
    flight, other = session(policy=policy, **values), session(**values)
    assert flight.policy == policy and flight.policies == (policy, *other.policies)
    flight.choose(other.policy)
    assert flight.policy == other.policy
    flight.choose(policy)
    assert flight.policy == policy


@pytest.mark.parametrize("task", ["track_circle", "circle.yaml"])
def test_a_configuration_of_a_task_is_shown_with_a_rig(tmp_path, monkeypatch, task):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "circle.yaml").write_text("base: track_circle\n")
    flown = session(task=task, config="rigs/falcon3", **{"env.policy_hz": 25}).vec.config
    assert (flown.task, flown.task_options["path"], flown.env.episode_seconds) == ("track", "circle", 20.0)
    rig, circle = load_config("rigs/falcon3"), load_config("track_circle")
    assert (flown.env.num_drones, flown.payload, flown.cable, flown.vehicle) == (3, rig.payload, rig.cable, rig.vehicle)
    assert flown.control.drag_feedforward and flown.train == circle.train and flown.env.policy_hz == 25
    assert session(task="track", config="rigs/falcon3").vec.config.task_options.get("path") != "circle"
