"""Comparisons of policies: rates, intervals, gains and tables, by numbers that were worked out apart."""

from __future__ import annotations

import json

import numpy as np
import pytest

from multilift_marl.evaluation.metrics import (
    _ROWS,
    FEWEST,
    bootstrap,
    bootstrap_seeds,
    compare,
    format_table,
    is_better,
    is_gain,
    join_episodes,
    summarize,
    wilson,
)
from multilift_marl.mdp.failures import CAUSES


def episodes(count: int = 40, seed: int = 0) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    values = {key.removesuffix("_held"): rng.normal(5, 1, count) for key, *_ in _ROWS}
    values |= {"success_rate": rng.random(count) < 0.6, "precise_rate": rng.random(count) < 0.3}
    values["failure_cause"] = np.where(values["success_rate"], 0, rng.integers(0, 3, count))
    return values


@pytest.mark.parametrize("successes, trials", [(0, 7), (3, 7), (7, 7), (50, 200)])
def test_a_rates_interval_is_where_the_score_test_rejects(successes, trials):
    low, high = wilson(successes, trials)
    for bound in (low, high):
        if 0 < bound < 1:
            score = (successes / trials - bound) / np.sqrt(bound * (1 - bound) / trials)
            assert abs(score) == pytest.approx(1.959964, rel=1e-9)
    assert (low == 0) == (successes == 0) and (high == 1) == (successes == trials)
    assert low <= successes / trials <= high


def test_a_means_interval_is_that_of_resampled_means():
    values = np.random.default_rng(3).exponential(2.0, 400)
    low, high = bootstrap(values)
    half = 1.959964 * values.std() / np.sqrt(400)
    assert low == pytest.approx(values.mean() - half, abs=0.15 * half)
    assert high == pytest.approx(values.mean() + half, abs=0.15 * half)
    assert bootstrap(values) == (low, high) != bootstrap(values, seed=1)


def test_many_episodes_are_drawn_in_parts_and_as_those_of_few(monkeypatch):
    values = np.random.default_rng(3).exponential(2.0, 37)
    whole = bootstrap(values)
    monkeypatch.setattr("multilift_marl.evaluation.metrics._AT_ONCE", 100)
    assert bootstrap(values) == whole


def test_of_few_episodes_no_mean_has_an_interval_and_no_policy_is_better():
    """Of equal policies the bootstrap alone calls one better in a half of single episodes."""
    rng = np.random.default_rng(0)
    for count in range(1, FEWEST):
        few = episodes(count)
        assert summarize(few)["energy_j"] == {"mean": pytest.approx(few["energy_j"].mean()), "ci95": None}
        assert summarize(few)["success_rate"]["ci95"] == list(wilson(int(few["success_rate"].sum()), count))
        assert not is_gain(np.zeros(count), np.full(count, -1.0))
    assert is_gain(np.zeros(FEWEST), np.full(FEWEST, -1.0))
    assert not is_gain(np.r_[np.zeros(FEWEST - 1), [1, -1]], np.full(FEWEST + 1, -1.0))
    wrong = sum(is_gain(np.zeros(FEWEST), rng.normal(size=FEWEST)) for _ in range(1000))
    assert wrong < 70


def test_episodes_where_a_metric_has_no_number_do_not_count_in_it():
    first, second = episodes(), episodes(seed=1)
    for each, gaps in ((first, slice(0, 8)), (second, slice(5, 11))):
        each["own"] = np.arange(40.0) ** 2
        each["own"][gaps] = np.nan
        each["never"] = np.full(40, np.inf)
    assert summarize(first)["own"] == {
        "mean": pytest.approx(first["own"][8:].mean()), "ci95": list(bootstrap(first["own"][8:]))
    }  # fmt: skip
    assert compare(first, second | {"own": 2 * second["own"]})["own"]["mean"] == pytest.approx(
        -(np.arange(11.0, 40.0) ** 2).mean()
    )
    for found in (summarize(first), compare(first, second)):
        assert "never" not in found
        json.dumps(found, allow_nan=False)


def test_what_only_some_teams_have_is_left_out_of_their_common_episodes():
    first, second = episodes(3), episodes(5)
    del second["energy_j"]
    for parts in ((first, second), (second, first)):
        found = join_episodes(parts)
        assert set(found) == set(second)
        assert found["return"].tolist() == [*parts[0]["return"], *parts[1]["return"]]


def test_an_interval_over_training_seeds_has_the_variances_of_seeds_and_of_episodes():
    rng, half = np.random.default_rng(5), {}
    seeds, episodes = rng.normal(0, 0.5, (40, 1)), rng.normal(0, 2.0, (1, 500))
    for name, values in (
        ("seeds", seeds + 0 * episodes),
        ("episodes", 0 * seeds + episodes),
        ("both", seeds + episodes),
    ):
        low, high = bootstrap_seeds(values)
        assert low < values.mean() < high
        half[name] = 0.5 * (high - low)
    assert half["seeds"] == pytest.approx(1.959964 * seeds.std() / np.sqrt(40), rel=0.1)
    assert half["episodes"] == pytest.approx(1.959964 * episodes.std() / np.sqrt(500), rel=0.1)
    assert half["both"] == pytest.approx(np.hypot(half["seeds"], half["episodes"]), rel=0.1)


@pytest.mark.parametrize("spread, least, most", [(10.0, 0.65, 0.85), (1.0, 0.9, 1.0)])
def test_of_three_training_seeds_the_interval_covers_as_stated(spread, least, most):
    """`spread`: of seeds, over the uncertainty of the mean of episodes."""
    rng = np.random.default_rng(1)
    hits = 0
    for _ in range(120):
        seeds, common, own = rng.normal(size=(3, 1)), rng.normal(size=(1, 60)), rng.normal(size=(3, 60))
        low, high = bootstrap_seeds(spread / np.sqrt(60) * seeds + common + 0.5 * own)
        hits += low <= 0 <= high
    assert least <= hits / 120 <= most


def test_of_one_training_seed_the_interval_is_that_of_episodes_and_gaps_do_not_count():
    values = np.random.default_rng(3).exponential(2.0, 400)
    assert bootstrap_seeds(values[None]) == pytest.approx(bootstrap(values), rel=0.02)
    gaps = np.concatenate([values, np.full(400, np.nan)])
    assert bootstrap_seeds(gaps[None]) == pytest.approx(bootstrap(values), rel=0.03)


def test_a_summary_has_each_metric_over_all_over_those_that_held_and_over_successes():
    flown = episodes()
    summary = summarize(flown)
    success, cause = flown["success_rate"], flown["failure_cause"]
    assert summary["success_rate"]["mean"] == success.mean()
    assert summary["precise_rate"]["ci95"] == list(wilson(int(flown["precise_rate"].sum()), 40))
    for name in ("payload_position_error_m", "settling_time_s", "payload_rmse_m"):
        assert summary[name]["mean"] == pytest.approx(flown[name].mean())
        assert summary[f"{name}_held"]["mean"] == pytest.approx(flown[name][cause == 0].mean())
        assert summary[f"{name}_successful"]["mean"] == pytest.approx(flown[name][success].mean())
    assert "energy_j_held" not in summary and "failure_cause" not in summary and "failure_none_rate" not in summary
    for index, name in enumerate(CAUSES[1:], 1):
        assert summary[f"failure_{name}_rate"]["mean"] == (cause == index).mean()


def test_differences_are_policy_minus_baseline_pair_by_pair():
    first, second = episodes(), episodes(seed=1)
    paired = compare(first, second)
    assert "failure_cause" not in paired
    for name, each in paired.items():
        difference = first[name].astype(float) - second[name].astype(float)
        assert each["mean"] == pytest.approx(difference.mean())
        assert each["ci95"] == list(bootstrap(difference))


CASES = {  # differences of success and error: whether that is a gain, also by the means alone
    "more success": ([1] * 12 + [0] * 28, [0.0] * 40, True, True),
    "less success": ([-1] * 12 + [0] * 28, [-1.0] * 40, False, False),
    "as much success, less error": ([0] * 40, [-0.1, -0.2] * 20, True, True),
    "as much success, more error": ([0] * 40, [0.1, 0.2] * 20, False, False),
    "error within the noise": ([0] * 40, [-1.0] * 21 + [1.0] * 19, False, True),
    "a little less success, less error": ([-1, 1, -1] + [0] * 37, [-0.1, -0.2] * 20, False, False),
    "error of those that end otherwise alone": ([1, -1] + [0] * 38, [-9.0, -9.0] + [0.1] * 38, False, False),
    "nothing alike": ([1, -1] * 20, [-9.0] * 40, False, False),
}


ERROR = "payload_position_error_m"


@pytest.mark.parametrize("success, error, gain, by_means", CASES.values(), ids=CASES)
def test_a_gain_is_in_success_first_and_then_in_the_error_of_episodes_that_end_alike(success, error, gain, by_means):
    success, error = np.array(success, float), np.array(error)
    assert is_gain(success, error) == gain
    other = {"success_rate": success < 0, "payload_position_error_m": np.full(40, 5.0)}
    policy = {"success_rate": success > 0, "payload_position_error_m": 5.0 + error}
    assert is_better(policy, other, ERROR) == gain and is_better(policy, other, ERROR, beyond_noise=False) == by_means


def test_a_table_has_means_and_intervals_in_its_units():
    flown, other = episodes(), episodes(seed=1)
    summaries = {"policy": summarize(flown), "baselines": {"script": summarize(other)}}
    lines = format_table(summaries, "mine").splitlines()
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    assert (
        cells[0] == ["", "mine", "script"] and set(lines[1]) == {"|", "-"} and len({len(line) for line in lines}) == 1
    )
    rows = {row[0]: row[1:] for row in cells[2:]}
    for key, heading, factor, digits in _ROWS:
        for cell, summary in zip(rows[heading], (summarize(flown), summarize(other)), strict=True):
            value = summary[key]
            numbers = [factor * value["mean"], *(factor * bound for bound in value["ci95"])]
            assert cell == "{0:.{3}f} ({1:.{3}f} - {2:.{3}f})".format(*numbers, digits)
    percent = {
        "success [%]",
        "within 1 cm and 1 deg [%]",
        "position error [cm]",
        "... without failure [cm]",
        "RMSE [cm]",
    }
    assert {heading for _, heading, factor, _ in _ROWS if factor == 100} == percent
    found = (flown["failure_cause"] == 1).mean()
    assert rows["ground [%]"][0].startswith(f"{100 * found:.1f} (")
    assert "tilt [%]" not in rows  # nobody has failed so


def test_a_row_that_one_policy_has_stands_in_the_table():
    one, other = summarize(episodes()), summarize(episodes(seed=1))
    key, heading, *_ = next(row for row in _ROWS if row[0] in one)
    lines = format_table({"policy": one, "baselines": {"script": other | {key: None}}}, "mine").splitlines()
    [line] = [each for each in lines if each.startswith(f"| {heading} ")]
    assert line.rstrip(" |").endswith("-") and line.count("(") == 1
    gone = format_table({"policy": one | {key: None}, "baselines": {"script": other | {key: None}}}, "mine")
    assert f"| {heading} " not in gone
