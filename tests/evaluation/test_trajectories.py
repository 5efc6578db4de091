"""Trajectories of evaluated episodes: the flight's own numbers, NaN behind its end, the same by any batches."""

import csv
import json
from functools import partial

import numpy as np
import pytest
from conftest import refusal

import multilift_marl as ml
from multilift_marl.cli.evaluate import main as evaluate
from multilift_marl.config.load import load_config
from multilift_marl.envs.core import EVALUATION, MultiliftVec
from multilift_marl.evaluation import rollout, trajectories
from multilift_marl.evaluation.rollout import run_episodes, trace_episode
from multilift_marl.evaluation.trajectories import QUANTITIES, Recording, TrajectoryWriter, make_arrays
from multilift_marl.policies.baselines import make_scripted

SHORT = {"env.episode_seconds": 0.4}
WILD = {"env.episode_seconds": 1.0, "control.max_offset": 5.0, "control.reference_speed": 20.0}
FORMATION = partial(make_scripted, "formation")


class Restless:
    """Sends the drones of odd environments through each other, so that their episodes end early."""

    def __init__(self, vec):
        sign = np.where((vec.first_env + np.arange(vec.num_envs)) % 2, -1.0, 0.0)
        self.action = np.tile(sign[:, None, None], (1, vec.num_drones, vec.action_size))

    def reset(self, mask=None):
        pass

    def act(self, observation):
        return self.action


def fly(folder, make_policy=FORMATION, episodes=5, **overrides):
    """Return what trajectories.npz holds of some episodes."""
    folder.mkdir(exist_ok=True)
    config = load_config("hover", SHORT | overrides)
    with TrajectoryWriter(folder, config, episodes, 5) as writer:
        flown = run_episodes(config, make_policy, episodes, 5, record=writer.record)
        writer.finish()
    assert sorted(path.name for path in folder.iterdir()) == sorted(path.name for path in writer.files)
    with np.load(folder / "trajectories.npz") as found:
        return flown, dict(found)


def test_it_is_the_flight_with_its_start(tmp_path):
    _, found = fly(tmp_path / "out")
    vec = MultiliftVec(load_config("hover", SHORT | {"env.num_envs": 1}), EVALUATION, first_env=3)
    observation, _ = vec.reset(seed=5)
    policy = FORMATION(vec)
    assert found["steps"].tolist() == [vec.max_steps] * 5 and found["time"] == pytest.approx(0.02 * np.arange(21))
    for step in range(vec.max_steps + 1):
        for name, quantity in QUANTITIES.items():
            row = found[name][3, step]
            if step == 0 and name in ("action", "rotor_thrust"):
                assert np.isnan(row).all()
            else:
                assert (row == quantity.read(vec)[0]).all(), (name, step)
        if step < vec.max_steps:
            observation, *_ = vec.step(policy.act(observation))
    trace = trace_episode(load_config("hover", SHORT), FORMATION, 3, 5)
    assert (found["payload_position"][3, 1:] == trace.payload_position).all()
    assert (found["cable_tension"][3, 1:] == trace.tension).all()
    about = json.loads(str(found["about"]))
    assert about["arrays"].keys() == found.keys() - {"about"} and about["action_names"] == list(vec.action_names)
    hover = vec.world.system.vehicle.mass * 9.81 / 4
    assert np.nanmean(found["rotor_thrust"]) == pytest.approx(hover + 1.4 * 9.81 / 16, rel=0.2)  # cables lean outward


def test_behind_its_end_an_episode_holds_nothing_by_any_batches(tmp_path, monkeypatch):
    flown, whole = fly(tmp_path / "whole", Restless, **WILD)
    monkeypatch.setattr(rollout, "_BATCH", 2)
    _, parts = fly(tmp_path / "parts", Restless, **WILD)
    for name, array in whole.items():
        np.testing.assert_array_equal(array, parts[name], err_msg=name)
    failed = flown["failure_cause"] > 0
    assert failed.tolist() == [False, True, False, True, False]
    assert ((whole["steps"] < 50) == failed).all()
    for i, steps in enumerate(whole["steps"]):
        for name in QUANTITIES:
            assert np.isfinite(whole[name][i, 1 : steps + 1]).all() and np.isnan(whole[name][i, steps + 1 :]).all()


def test_parts_that_are_flown_elsewhere_are_the_same(tmp_path):
    _, whole = fly(tmp_path / "whole")
    config = load_config("hover", SHORT)
    with TrajectoryWriter(tmp_path, config, 5, 5) as writer:
        for first, count in ((3, 2), (0, 3)):
            arrays = make_arrays(MultiliftVec(config), count)
            run_episodes(config, FORMATION, count, 5, first=first, record=partial(Recording, arrays))
            writer.put(first, arrays)
        writer.finish()
    for name, array in np.load(tmp_path / "trajectories.npz").items():
        np.testing.assert_array_equal(array, whole[name], err_msg=name)


@pytest.mark.slow
def test_workers_record_the_same(tmp_path):
    pytest.importorskip("ray")
    asked = ["policy=formation", "config=hover", "episodes=40", "baseline=none", "trajectories=true", "ray=local"]
    for workers in (0, 1):
        assert (
            evaluate([*asked, "env.episode_seconds=0.4", f"workers={workers}", f"out={tmp_path / str(workers)}"]) == 0
        )
    one, other = (tmp_path / name / "trajectories.npz" for name in "01")
    assert one.read_bytes() == other.read_bytes()


@pytest.mark.parametrize("kind", ["csv", "parquet"])
def test_the_table_has_the_same_numbers(tmp_path, monkeypatch, kind):
    if kind == "parquet":
        parquet = pytest.importorskip("pyarrow.parquet")
        monkeypatch.setattr(trajectories, "_GROUP", 30)  # rows: the first episode's 51 are one group, the others next
    else:
        monkeypatch.setattr(trajectories, "find_spec", lambda name: None)
    _, found = fly(tmp_path, Restless, 2, **WILD)
    if kind == "parquet":
        read = parquet.read_table(tmp_path / "trajectories.parquet")
        assert parquet.ParquetFile(tmp_path / "trajectories.parquet").num_row_groups == 2
        table = {name: read[name].to_numpy() for name in read.column_names}
    else:
        with open(tmp_path / "trajectories.csv", newline="") as file:
            rows = list(csv.DictReader(file))
        table = {name: np.array([float(row[name] or "nan") for row in rows]) for name in rows[0]}
    steps = found["steps"]
    assert table["episode"].tolist() == [0] * (steps[0] + 1) + [1] * (steps[1] + 1)
    second = table["episode"] == 1
    assert (table["step"][second] == np.arange(steps[1] + 1)).all()
    assert (table["time"][second] == found["time"][: steps[1] + 1]).all()
    for column, values in (
        ("drone_position_2_1", found["drone_position"][1, :, 2, 1]),
        ("payload_rotation_0_2", found["payload_rotation"][1, :, 0, 2]),
        ("rotor_thrust_3_0", found["rotor_thrust"][1, :, 3, 0]),
        ("reference_yaw_1", found["reference_yaw"][1, :, 1]),
    ):
        np.testing.assert_array_equal(table[column][second], values[: steps[1] + 1], err_msg=column)
    size = sum(int(np.prod(found[name].shape[2:])) for name in QUANTITIES)
    assert len(table) == 3 + size


def test_the_bag_of_an_episode_holds_the_same(tmp_path):
    pytest.importorskip("rosbags")
    from test_ros import read

    short = [f"{key}={value}" for key, value in SHORT.items()]
    asked = ["policy=formation", "config=hover", "episodes=2", "seed=5", "baseline=none", "trajectories=true"]
    assert evaluate([*asked, *short, f"out={tmp_path / 'out'}", f"bag={tmp_path / 'bag'}"]) == 0
    found, heard = np.load(tmp_path / "out" / "trajectories.npz"), read(tmp_path / "bag")
    for topic, name in (("/drone_1/reference", "reference_position"), ("/drone_1/odom", "drone_position")):
        poses = [getattr(message.pose, "pose", message.pose).position for _, message, _ in heard[topic]]
        assert (np.array([[p.x, p.y, p.z] for p in poses]) == found[name][0, :, 1]).all()
    tension = np.array([message.effort for _, message, _ in heard["/cables"]])
    assert (tension == found["cable_tension"][0]).all()
    actions = np.array([message.data for _, message, _ in heard["/drone_1/action"]])
    assert (actions == found["action"][0, 1:, 1].astype(np.float32)).all()
    assert [time for time, *_ in heard["/cables"]] == np.round(found["time"] * 1e9).astype(int).tolist()


def test_what_cannot_be_written_is_refused_before_the_work(tmp_path, monkeypatch, capsys):
    config = load_config("hover", SHORT)
    (tmp_path / "trajectories.npz").mkdir()
    assert "which is a folder; give another folder by out=" in refusal(TrajectoryWriter, tmp_path, config, 5, 5)
    message = refusal(TrajectoryWriter, tmp_path.parent, config, 10**9, 5)
    assert "ask for fewer episodes" in message and "GB" in message
    asked = ["policy=formation", "baseline=none", "trajectories=true", "episodes=1", "out=/dev/null"]
    assert evaluate(asked) == 2 and "cannot write into /dev/null" in capsys.readouterr().err


def test_nothing_is_left_of_what_is_given_up(tmp_path):
    with pytest.raises(KeyboardInterrupt), TrajectoryWriter(tmp_path, load_config("hover", SHORT), 2, 5) as writer:
        Recording(writer._arrays)(ml.make_vec("hover", num_envs=2, **SHORT))
        raise KeyboardInterrupt
    assert not list(tmp_path.iterdir())
