"""What a training says of itself: its curves hold whole episodes, its best policy is the best, and gains are gains."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from conftest import SMALL, make_trainer, refusal

from multilift_marl.agents import evaluator
from multilift_marl.agents.checkpoint import load_checkpoint
from multilift_marl.agents.evaluator import Evaluator, Gain
from multilift_marl.agents.logging import describe_evaluation, read_metrics
from multilift_marl.agents.trainer import Trainer, new_run
from multilift_marl.cli.train import _compare
from multilift_marl.cli.train import main as train
from multilift_marl.config.load import load_config
from multilift_marl.envs.core import TRAINING_EVALUATION
from multilift_marl.evaluation.metrics import is_better
from multilift_marl.evaluation.rollout import run_episodes
from multilift_marl.policies.baselines import LINEAR

PICTURE = Path(__file__).parents[2] / "docs" / "images" / "errors.png"
ERROR = "payload_position_error_m"
EVALUATED = (0, 4, 8, 10)  # iterations of SMALL


def flight(errors, success=True):
    """Return what `run_episodes` measures of episodes with these position errors [m], as far as training looks."""
    names = (ERROR, "payload_rmse_m", "payload_attitude_error_deg", "settling_time_s", "return")
    flown = {name: np.array(errors, float) for name in names}
    return flown | {"success_rate": np.full(len(errors), success), "failure_cause": np.zeros(len(errors), int)}


def test_only_whole_episodes_stand_in_the_curves(tmp_path):
    trainer = make_trainer(tmp_path, **{"env.episode_seconds": 0.5})
    steps, logged = trainer.env.vec.max_steps, []
    for _ in range(6):
        [batch] = trainer.rollouts.collect(trainer.iteration)
        batch["next", "agents", "reward"].fill_(1.0)
        values = trainer.episodes.read([batch], trainer.iteration)
        trainer.iteration += 1
        if "return" in values:
            logged.append((trainer.iteration * 16, values["return"]))
    assert min(step for step, _ in logged) > steps  # before, only failures could have ended
    assert {total for _, total in logged} == {steps}


@pytest.mark.parametrize(
    ("keep", "evaluated", "confirmed", "best"),
    [
        ("best", (3, 1, 2, 2.5), (3, 1, 2, 2.5), 4),  # neither the first nor the last
        ("best", (3, 1, 2, 2.5), (3, 4, 2, 2.5), 8),  # iteration 4 was lucky
        ("best", (3, 1, 2, 2.5), (3, 4, 3, 5), 0),  # nothing is better than the script
        ("best", (3, 4, 2, 1), (3, 4, 2, 1), 10),
        ("last", (3, 1, 2, 2.5), (3, 1, 2, 2.5), 10),
    ],
)
def test_the_best_policy_is_the_best_on_fresh_episodes_too(tmp_path, monkeypatch, keep, evaluated, confirmed, best):
    blocks, weights = set(), {}

    def step(trainer):
        trainer.iteration += 1
        with torch.no_grad():
            trainer.learner.actor.team.net[-1].bias += 1
        return {}

    def fly(config, make_policy, episodes, seed, purpose, first=0):
        assert purpose == TRAINING_EVALUATION
        policy = getattr(make_policy, "__self__", None)
        index = 0 if policy is None else EVALUATED.index(policy.frames // (8 * 16))
        if policy is not None:
            weights[EVALUATED[index]] = policy.actor.state_dict()
        blocks.add(first)
        error = (confirmed if first else evaluated)[index]
        return flight(error + np.random.default_rng(first).normal(0, 0.1, episodes))

    monkeypatch.setattr(evaluator, "run_episodes", fly)
    monkeypatch.setattr(Trainer, "step", step)
    monkeypatch.setattr(Evaluator, "draw_best", lambda evaluator, folder: PICTURE)
    trainer = make_trainer(tmp_path, **{"eval.episodes": 40, "eval.keep": keep})
    assert trainer.run()
    kept = load_checkpoint(trainer.folder / "checkpoints" / "best.pt")
    assert kept["iteration"] == best
    assert all(torch.equal(tensor, weights[best][name]) for name, tensor in kept["actor"].items())
    row = read_metrics(trainer.folder)[-1]
    assert float(row["eval/best_iteration"]) == best
    assert float(row["final/gained"]) == (best > 0)
    assert float(row["final/script_payload_position_error_m"]) == pytest.approx(3, abs=0.1)
    learned = confirmed[EVALUATED.index(best)]
    assert float(row["final/learned_payload_position_error_m"]) == pytest.approx(learned, abs=0.1)
    assert len(blocks) > 1 + (keep == "best")  # no block that something was chosen by is flown twice


@pytest.mark.parametrize(
    ("success", "errors", "expected"),
    [
        ((1.0, 1.0), (0.9, 1.0), True),
        ((1.0, 1.0), (1.0, 1.0), False),
        ((1.0, 1.0), (1.1, 1.0), False),
        ((1.0, 0.5), (1.1, 1.0), True),
        ((0.95, 1.0), (0.5, 1.0), False),  # a smaller error does not make up for failures
    ],
)
def test_better_is_in_success_first_and_beyond_noise(success, errors, expected):
    rng, flown = np.random.default_rng(0), []
    for rate, error in zip(success, errors, strict=True):
        flown.append(flight(error + rng.normal(0, 0.01, 100)))
        flown[-1]["success_rate"] = np.arange(100) < 100 * rate
    assert is_better(*flown, ERROR) == expected


def test_by_the_means_alone_any_difference_counts_success_first():
    rng = np.random.default_rng(1)
    flown = [flight(error + rng.normal(0, 0.3, 100)) for error in (0.98, 1.0)]
    assert flown[0]["payload_position_error_m"].mean() < flown[1]["payload_position_error_m"].mean()
    assert not is_better(*flown, ERROR) and is_better(*flown, ERROR, beyond_noise=False)
    assert not is_better(*reversed(flown), ERROR, beyond_noise=False)
    assert not is_better(flown[0], flown[0], ERROR, beyond_noise=False)
    flown[0]["success_rate"] = np.arange(100) > 0
    assert not is_better(*flown, ERROR, beyond_noise=False) and is_better(*reversed(flown), ERROR, beyond_noise=False)


@pytest.mark.parametrize("episodes, first", [(10, True), (9, False)])  # so few have no noise that a gain is beyond
def test_the_first_trained_policy_must_beat_the_script_beyond_noise_later_ones_by_the_means(
    tmp_path, monkeypatch, episodes, first
):
    trainer, asked = make_trainer(tmp_path, **{"eval.episodes": episodes}), []
    monkeypatch.setattr(evaluator, "is_better", lambda *flown, beyond_noise: asked.append(beyond_noise) or True)
    monkeypatch.setattr(evaluator, "run_episodes", lambda *a, **k: flight(np.full(3, 1.0 - 0.1 * trainer.iteration)))
    for trainer.iteration in range(4):
        trainer.evaluator.evaluate(trainer._content())
    assert asked == [first, False, False]


def test_a_team_that_tracks_is_judged_by_its_error_along_the_path(tmp_path, monkeypatch):
    trainer = new_run(load_config("track", SMALL), "test", tmp_path)

    def fly(*args, **kwargs):
        flown = flight(np.full(3, 0.01 * (1 + trainer.iteration)))  # where it ends: worse and worse
        return flown | {"payload_rmse_m": np.full(3, (0.07, 0.05, 0.06)[trainer.iteration])}

    asked = []
    monkeypatch.setattr(evaluator, "run_episodes", fly)
    monkeypatch.setattr(evaluator, "is_better", lambda *flown, **kinds: asked.append(flown[2]) or True)
    for trainer.iteration in range(2):
        values = trainer.evaluator.evaluate(trainer._content())
    assert values["eval/best_iteration"] == 1 and trainer.evaluator.best["score"] == pytest.approx([1.0, -0.05])
    assert "RMSE" in describe_evaluation(0, values, trainer.evaluator.error, header=True)
    assert " 5.00 cm" in describe_evaluation(0, values, trainer.evaluator.error, header=True)
    trainer.gain = trainer.evaluator.measure_gain(2)
    assert "RMSE" in _compare(trainer) and "5.00 cm" in _compare(trainer)
    assert set(asked) == {"payload_rmse_m"}


@pytest.mark.parametrize("before", [{}, {"compared_by": "payload_rmse_m", "episodes": 3}, {"episodes": 1}])
def test_a_score_of_other_episodes_or_another_error_is_measured_anew(tmp_path, monkeypatch, before):
    """A run that an older version began, or that is resumed with other eval.episodes: a lucky score would stay."""
    trainer = make_trainer(tmp_path, **{"eval.episodes": 3})
    errors = {0: 0.2, 1: 0.1}
    monkeypatch.setattr(evaluator, "run_episodes", lambda *a, **k: flight(np.full(3, errors[flying[0]])))
    flying, own = [0], trainer.evaluator
    own.evaluate(trainer._content())
    assert own.best["score"] == pytest.approx([1.0, -0.2])
    lucky = {name: value for name, value in own.best.items() if name not in ("compared_by", "episodes")}
    own.best = lucky | before | {"score": [1.0, -0.001]}
    # What flies next: the candidate, then the best policy, and both on fresh episodes.
    turns = iter([1, 0, 1, 0])
    fly = own._fly
    monkeypatch.setattr(own, "_fly", lambda *arguments: flying.__setitem__(0, next(turns)) or fly(*arguments))
    trainer.iteration = 1
    assert own.evaluate(trainer._content())["eval/best_iteration"] == 1
    assert own.best["score"] == pytest.approx([1.0, -0.1]) and own.best["episodes"] == 3


def test_an_error_that_no_metric_has_is_named(tmp_path, monkeypatch):
    trainer = make_trainer(tmp_path)
    monkeypatch.setattr(trainer.evaluator, "error", "payload_rms_m")
    message = refusal(trainer.evaluator.evaluate, trainer._content())
    assert message.startswith("task hover: ERROR names no metric, 'payload_rms_m'; did you mean 'payload_rmse_m'?")


def test_one_lost_payload_on_each_side_does_not_hide_a_smaller_error():
    rng, flown = np.random.default_rng(0), []
    for error, lost in ((0.03, 3), (0.04, 5)):
        flown.append(flight(error + rng.normal(0, 0.001, 100)))
        flown[-1]["success_rate"] = np.arange(100) != lost
        flown[-1]["payload_position_error_m"][lost] = 3.0
    assert is_better(*flown, ERROR) and not is_better(*reversed(flown), ERROR)


def test_the_untrained_policy_flies_the_script_and_is_evaluated(tmp_path):
    trainer = make_trainer(tmp_path, **{"train.residual": "formation_feedback", "train.frames": 128})
    trainer.run()
    rows = read_metrics(trainer.folder)
    assert [(row["iteration"], row["frames"]) for row in rows] == [("0", "0"), ("1", "128")]
    script = run_episodes(trainer.config, LINEAR["formation_feedback"], 3, trainer.config.seed, TRAINING_EVALUATION)
    for name in ("payload_position_error_m", "return"):
        assert float(rows[0][f"eval/{name}"]) == pytest.approx(script[name].mean(), rel=1e-5)


def test_a_training_that_gains_nothing_says_so(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    settings = SMALL | {"train.learning_rate": 1e-12, "train.critic_learning_rate": 1e-12, "train.frames": 256}
    assert train([f"{key}={value}" for key, value in settings.items()]) == 0
    shown = capsys.readouterr().out
    rows = [line.split() for line in shown.splitlines()]
    steps = [row[0] for row in rows if len(row) > 4 and row[1].endswith("%")]
    assert steps[0] == "0" and int(steps[-1].replace(",", "")) >= 256 and len(steps) == len(set(steps)) >= 2
    before, learned = (next(row for row in rows if row[:1] == [name]) for name in ("before:", "learned"))
    assert before[1:3] == ["zero", "actions"] and before[-3:] == learned[-3:]  # the same policy, the same episodes
    assert "no significant difference" in shown and "on 3 episodes" in shown


VERDICTS = {"better": (True, False), "worse": (False, True), "no significant difference": (False, False)}


@pytest.mark.parametrize("verdict", VERDICTS)
def test_a_training_ends_with_one_of_three_verdicts(verdict):
    metrics = {"success_rate": 0.5, "payload_position_error_m": 0.1}
    trainer = SimpleNamespace(
        gain=Gain(metrics, metrics, *VERDICTS[verdict]), evaluator=SimpleNamespace(best={"iteration": 7}, error=ERROR),
        config=load_config("hover"),
    )  # fmt: skip
    assert _compare(trainer).splitlines()[-1].startswith(verdict)
