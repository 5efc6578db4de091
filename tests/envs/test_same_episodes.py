"""Teams that are compared fly the same episodes: digests of how each begins, with all that is hidden in it."""

from __future__ import annotations

import hashlib
import json
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest

from multilift_marl.cli.evaluate import main as evaluate
from multilift_marl.config.load import load_config
from multilift_marl.envs.core import EVALUATION, TRAINING_EVALUATION
from multilift_marl.evaluation import rollout
from multilift_marl.evaluation.rollout import run_episodes, trace_episode
from multilift_marl.policies.baselines import make_scripted

SHORT = {"env.episode_seconds": 0.04, "env.num_threads": 1}


def digest(vec, e: int) -> str:
    """Return what environment e starts with: state, goal, hidden parameters and loads, random numbers to come."""
    world = vec.world
    parts = [*world.state, *world.parameters, *world.hidden_loads, *world.air, vec.task.goal.position]
    parts += [vec.task.goal.rotation, *vec._starts.drawn.values()]
    sha = hashlib.sha256(b"".join(np.ascontiguousarray(part[e]).tobytes() for part in parts))
    return sha.hexdigest()[:16]


@pytest.fixture
def begun(monkeypatch):
    """Collect the digests of all episodes that are measured, a list for each batch, with its purpose."""
    found, measure = [], rollout.measure_episodes

    def note(vec, policy, observation, on_step=None):
        found.append((vec.purpose, [digest(vec, e) for e in range(vec.num_envs)]))
        return measure(vec, policy, observation, on_step)

    monkeypatch.setattr(rollout, "measure_episodes", note)
    return found


def test_the_command_flies_policy_and_all_baselines_in_the_same_episodes(begun, tmp_path):
    keys = [f"{key}={value}" for key, value in SHORT.items()]
    settings = ["policy=formation", "config=hover", "baseline=payload_geometric", "episodes=3", "seed=7"]
    assert evaluate([*settings, f"out={tmp_path}", *keys]) == 0
    teams = 1 + len(json.loads((tmp_path / "metrics.json").read_text())["baselines"])
    assert len(begun) == teams > 3
    purposes, digests = zip(*begun, strict=True)
    assert set(purposes) == {EVALUATION}
    assert all(each == digests[0] for each in digests) and len(set(digests[0])) == 3


def test_another_seed_or_number_is_another_episode_and_batches_join_without_a_gap(begun, monkeypatch):
    config, make = load_config("hover", SHORT), partial(make_scripted, "formation")
    run_episodes(config, make, 5, seed=3)
    monkeypatch.setattr(rollout, "_BATCH", 2)
    run_episodes(config, make, 5, seed=3)
    run_episodes(config, make, 3, seed=3, first=2)
    run_episodes(config, make, 5, seed=4)
    batches = iter(digests for _, digests in begun)
    whole = next(batches)
    assert [*next(batches), *next(batches), *next(batches)] == whole
    assert [*next(batches), *next(batches)] == whole[2:]
    assert len({*whole, *next(batches), *next(batches), *next(batches)}) == 10


def test_a_trace_begins_as_the_episode_that_it_shows(begun):
    config, seen = load_config("hover", SHORT), []
    run_episodes(config, partial(make_scripted, "formation"), 3, seed=3)

    def noting(vec):
        policy = make_scripted("formation", vec)
        start = SimpleNamespace(
            reset=lambda mask=None: (seen.append(digest(vec, 0)), policy.reset(mask)), act=policy.act
        )
        return start

    for episode in range(3):
        trace_episode(config, noting, episode, seed=3)
    assert seen == begun[0][1]


def test_gain_is_measured_in_the_same_fresh_episodes_for_script_and_learned_team(begun, monkeypatch):
    pytest.importorskip("torch")
    from multilift_marl.agents.evaluator import Evaluator

    config = load_config("hover", SHORT | {"eval.episodes": 4, "train.residual": "formation"})
    evaluator = Evaluator(config)
    learned = SimpleNamespace(bind=partial(make_scripted, "formation_integral"), frames=0)
    monkeypatch.setattr(evaluator, "best_policy", lambda: learned)
    evaluator.measure_gain(5)
    evaluator._confirm(learned, 5)
    evaluator._fly(learned.bind, 0)
    purposes, digests = zip(*begun, strict=True)
    assert set(purposes) == {TRAINING_EVALUATION}
    gain, script, candidate, best, regular = digests
    assert gain == script and candidate == best
    assert len({*gain, *candidate, *regular}) == 12  # no episode decides twice


def test_processes_of_ray_fly_the_parts_of_the_same_episodes(begun):
    cloudpickle = pytest.importorskip("ray.cloudpickle", exc_type=ImportError)
    from multilift_marl.evaluation.parallel import Evaluation, _fly_part

    config, make = load_config("hover", SHORT), partial(make_scripted, "formation")
    whole = run_episodes(config, make, 5, seed=3)
    task = cloudpickle.dumps((config.model_dump(mode="json"), make, Evaluation(5, 3), False))
    parts = [_fly_part(task, first, count)[0] for first, count in ((0, 2), (2, 3))]
    digests = [each for _, each in begun]
    assert digests[0] == digests[1] + digests[2]
    for name, metric in whole.items():
        np.testing.assert_array_equal(np.concatenate([part[name] for part in parts]), metric, err_msg=name)


@pytest.mark.parametrize(
    "episodes, workers, parts",
    [
        (6, 2, [(0, 3), (3, 3)]),
        (5, 2, [(0, 3), (3, 2)]),
        (100, 2, [(0, 32), (32, 32), (64, 32), (96, 4)]),
        (1, 4, [(0, 1)]),
    ],
)
def test_every_worker_has_episodes_to_fly_if_there_are_enough(episodes, workers, parts):
    pytest.importorskip("ray")
    from multilift_marl.evaluation.parallel import divide_episodes

    assert divide_episodes(episodes, workers, 32) == parts
