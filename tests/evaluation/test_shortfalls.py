"""Why episodes were no success: each bound against a loop over the flight, and the counts of reports."""

from __future__ import annotations

import json

import numpy as np
import pytest
from conftest import TASKS
from plain_kernels import plain, record, turned

import multilift_marl as ml
from multilift_marl.config.load import load_config
from multilift_marl.evaluation import rollout
from multilift_marl.evaluation.metrics import compare, format_card, format_reasons, make_report, summarize
from multilift_marl.evaluation.rollout import run_episodes
from multilift_marl.evaluation.shortfalls import explain, format_explanation, is_shortfall
from multilift_marl.kernels.jit import inlined
from multilift_marl.mdp.criteria import Criterion
from multilift_marl.mdp.failures import CAUSES
from multilift_marl.policies.baselines import make_scripted
from multilift_marl.tasks import land
from multilift_marl.tasks.base import Kernels
from multilift_marl.tasks.hover import Hover

BOUNDS = {"task_options.success_distance": 0.15, "task_options.success_angle": 4.0}
FAST = {"env.episode_seconds": 3.0} | BOUNDS  # some keep to them in the last 2 s, some do not


def script(name="formation_integral"):
    return lambda vec: make_scripted(name, vec)


class Watcher:
    """Writes down of every step, of a batch at a time, what a success could depend on."""

    def __init__(self, read):
        self._read, self.batches = read, []

    def __call__(self, first):
        steps = []
        self.batches.append(steps)
        return lambda vec: steps.append([np.array(each) for each in self._read(vec)])

    def columns(self):
        """Return each quantity (steps, episodes), the start left out."""
        return [np.concatenate([np.array([s[k] for s in b[1:]]) for b in self.batches], 1) for k in range(4)]


def read_rest(vec):
    state, goal = vec.world.state, vec.task.goal
    away = np.linalg.norm(state.payload_position - goal.position, axis=1)
    turn = np.einsum("eij,ekj->eik", state.payload_rotation, goal.rotation)
    angle = np.rad2deg(np.arccos(np.clip((np.trace(turn, axis1=1, axis2=2) - 1) / 2, -1, 1)))
    speeds = (np.linalg.norm(each, axis=1) for each in (state.payload_velocity, state.payload_body_rates))
    return away, angle, *speeds


def held(good):
    """Return for how many steps (episodes,) all has been good at the end of `good` (steps, episodes)."""
    return np.array([len(g) if g.all() else np.argmax(~g[::-1]) for g in good.T])


@pytest.fixture(scope="module")
def hover():
    """Return 12 short episodes, in batches of 5, and a loop's view of them."""
    watch, before, rollout._BATCH = Watcher(read_rest), rollout._BATCH, 5
    try:
        return run_episodes(load_config("hover", FAST), script(), 12, seed=5, record=watch), watch.columns()
    finally:
        rollout._BATCH = before


def test_misses_of_hover_are_those_of_a_loop_over_the_flight(hover):
    episodes, (distance, angle, _, _) = hover
    missed = ~episodes["success_rate"]
    assert 0 < missed.sum() < 12 and not episodes["failure_cause"].any()
    last = slice(-100, None)  # 2 s
    beyond = {"distance_m": distance[last].max(0) - 0.15, "angle_deg": angle[last].max(0) - 4.0}
    beyond["time_held_s"] = 2.0 - 0.02 * held((distance <= 0.15) & (angle <= 4.0))
    assert {name for name in episodes if name.startswith("excess:")} == {f"excess:{name}" for name in beyond}
    for name, excess in beyond.items():
        expected = np.where(missed, np.maximum(excess, 0), 0)
        np.testing.assert_allclose(episodes[f"excess:{name}"], expected, atol=1e-6, err_msg=name)
    for name in ("distance_m", "angle_deg"):
        assert 0 < (episodes[f"excess:{name}"] > 0).sum() < 12
    told = explain(episodes, CAUSES)
    short = np.sort(beyond["time_held_s"][missed])
    assert told["missed"]["time_held_s"] == {
        "episodes": missed.sum(), "bound": 2.0, "median_excess": pytest.approx(np.median(short))
    }  # fmt: skip
    assert told["episodes"] == missed.sum() and told["unexplained"] == 0 and told["failures"] == {}


def test_batches_of_another_size_say_the_same(hover):
    again = run_episodes(load_config("hover", FAST), script(), 12, seed=5)
    for name in filter(is_shortfall, hover[0]):
        np.testing.assert_array_equal(again[name], hover[0][name], err_msg=name)


def test_they_are_no_metrics(hover):
    episodes = hover[0]
    assert not any(map(is_shortfall, (*summarize(episodes), *compare(episodes, episodes))))


SOFT = {  # bounds that some teams keep to and others do not
    "gate": {"task_options.success_distance": 0.002, "task_options.success_tension": 1.02},
    "hover": FAST,
    "land": {"task_options.success_seconds": 3.2, "task_options.clearance": 0.75},
    "loss": {"task_options.success_body_rate": 0.05, "task_options.success_tension": 2.0},
    "navigate": {"task_options.success_tension": 1.01, "task_options.success_distance": 0.05},
    "pose": {"task_options.success_distance": 0.02, "task_options.success_angle": 2.0},
    "recover": {"task_options.success_distance": 0.0015, "task_options.success_tension": 45.0},
    "regroup": {"task_options.success_distance": 0.5, "task_options.success_angle": 20.0},
    "takeoff": {"task_options.success_distance": 0.01, "task_options.success_tension": 1.3},
    "track": {"task_options.success_distance": 0.06},
}


@pytest.mark.parametrize(
    "name", [pytest.param(t, marks=[] if t in ("hover", "pose") else pytest.mark.slow) for t in TASKS]
)
def test_an_episode_without_failure_succeeds_where_it_misses_nothing(name):
    script_name = {"loss": "formation_redistributed", "gate": "formation_narrow"}.get(name, "formation_feedback")
    episodes = run_episodes(load_config(name, SOFT[name]), script(script_name), 16, seed=3)
    beyond = np.array([values > 0 for key, values in episodes.items() if key.startswith("excess:")])
    np.testing.assert_array_equal(beyond.any(axis=0), ~episodes["success_rate"] & (episodes["failure_cause"] == 0))
    assert beyond.any(), "choose bounds that are missed"
    told = explain(episodes, CAUSES)
    assert told["unexplained"] == 0
    assert (
        told["episodes"] == 16 - episodes["success_rate"].sum() == sum(told["failures"].values()) + beyond.any(0).sum()
    )


def test_targets_of_pose_count_one_by_one():
    watch = Watcher(read_rest)
    episodes = run_episodes(load_config("pose", SOFT["pose"]), script("formation_feedback"), 4, seed=3, record=watch)
    distance, angle, _, _ = watch.columns()
    last = np.zeros(len(distance), bool)
    ends = range(200, len(distance) + 1, 200)  # of targets: every 4 s
    for end in ends:
        last[end - 50 : end] = True  # 1 s
    missed = ~episodes["success_rate"] & (episodes["failure_cause"] == 0)
    assert missed.any() and (len(distance) % 200, len(ends)) == (0, 3)
    short = np.max([1.0 - 0.02 * held((distance[:e] <= 0.02) & (angle[:e] <= 2.0)) for e in ends], axis=0)
    for name, excess in (
        ("distance_m", distance[last].max(0) - 0.02), ("angle_deg", angle[last].max(0) - 2.0), ("time_held_s", short),
    ):  # fmt: skip
        expected = np.where(missed, np.maximum(excess, 0), 0)
        np.testing.assert_allclose(episodes[f"excess:{name}"], expected, atol=1e-6, err_msg=name)


@pytest.mark.parametrize("is_round", [False, True])
def test_room_and_height_of_landed_teams_are_those_that_success_asks_for(is_round):
    rng, n = np.random.default_rng(0), 3
    half, center = np.array([0.25, 0.25, 0.06]), (0.02, -0.01, 0.03)
    state = record(
        payload_position=rng.uniform(0.1, 0.4, (8, 3)), drone_position=rng.uniform(-0.6, 1.2, (8, n, 3)),
        payload_rotation=np.stack([turned(rng.normal(size=3), angle) for angle in rng.uniform(0, 0.6, 8)]),
    )  # fmt: skip
    limits = record(payload_half=half, payload_center=center, payload_round=is_round)
    room, low = land._room(state, limits), land.lowest_points(state, limits)
    for e in range(8):
        assert low[e] == pytest.approx(plain(land.load_height)(e, state, limits), abs=1e-12)
        for above, clear in ((room[e] - 1e-9, True), (room[e] + 1e-9, False)):
            view = record(state=state, limits=limits, settings=record(drone_half=0.0, clearance=above))
            assert all(plain(land._drone_clear)(e, k, view) for k in range(n)) == clear


@inlined
def is_near(e, v):
    """Payload within 3 cm."""
    return v.errors.distance[e] <= 0.03


def own(name, **declared):
    """Return short episodes of a task of one's own."""
    ml.register_task(type("Own", (Hover,), {"name": name, "__module__": __name__} | declared))
    return run_episodes(load_config("hover", {"task": name} | FAST), script(), 12, seed=5)


def test_a_region_of_ones_own_is_told_by_time_alone(registries):
    told = explain(own("near", KERNELS=Kernels(is_good=is_near)), CAUSES)
    assert set(told["missed"]) == {"time_held_s"} and told["unexplained"] == 0 and told["episodes"] > 0


def test_a_success_of_ones_own_is_not_explained_by_the_criteria_of_another(registries):
    def succeeded(self):
        return self.errors.angle < 1e-4

    episodes = own("own_success", succeeded=succeeded)
    told = explain(episodes, CAUSES)
    assert told == {"episodes": 12, "failures": {}, "missed": {}, "unexplained": 12}
    assert "not explained: 12" in format_explanation(told, "policy", 12)

    def criteria(self):
        return (Criterion("yaw_deg", 0.01, lambda: np.rad2deg(self.errors.angle) - 0.01, throughout=False),)

    told = explain(own("own_criteria", succeeded=succeeded, criteria=criteria, success_windows=lambda self: ()), CAUSES)
    assert told["missed"]["yaw_deg"]["episodes"] == 12 and told["unexplained"] == 0


def test_a_criterion_counts_from_the_first_step_of_its_window_to_the_last(registries):
    """The worst moment of a bound that is missed ever more, and ever less: the last and the first of 100 steps."""

    def criteria(self):
        more, less = (lambda sign=sign: sign * self.time for sign in (1, -1))
        return Criterion("more_s", 1.0, lambda: more() - 1.0), Criterion("less_s", -1.0, lambda: less() + 9.0)

    episodes = own("own_window", criteria=criteria, succeeded=lambda self: self.time < 0)
    assert episodes["excess:more_s"] == pytest.approx(np.full(12, 3.0 - 1.0))
    assert episodes["excess:less_s"] == pytest.approx(np.full(12, 9.0 - (3.0 - 2.0 + 0.02)))


def test_a_landed_team_misses_its_clearance_by_what_a_drone_lacks():
    vec = ml.make_vec("land", num_envs=2, **{"task_options.clearance": 0.3})
    vec.reset(seed=0)
    state, half = vec.world.state, vec.task.settings.drone_half
    state.payload_position[:], state.payload_rotation[:] = (0, 0, 1.0), np.eye(3)
    state.drone_position[:] = (0, 0, 5.0)
    reach = vec.world.system.payload_size[0] / 2
    state.drone_position[:, 1] = (reach + half + 0.2, 0, 1.0), (5.0, 0, half + 0.1)
    (criterion,) = (each for each in vec.task.criteria() if each.name == "clearance_m")
    lacks = vec.task.options.clearance - np.array([0.2, 0.1])
    assert criterion.excess() == pytest.approx(lacks) and criterion.bound == 0.3


def test_episodes_that_no_criterion_explains_are_those_without_a_failure():
    values = made(success_rate=np.zeros(6, bool))  # the first two missed nothing that is known
    assert explain(values, CAUSES)["unexplained"] == 2


def made(**more):
    """Return six episodes: two successes, a tilt, a collision, two that missed the criterion."""
    values = {
        "success_rate": np.array([True, True, False, False, False, False]),
        "failure_cause": np.array([0, 0, CAUSES.index("tilt"), CAUSES.index("drone_collision"), 0, 0]),
        "return": np.arange(6.0), "payload_position_error_m": np.ones(6),
        "excess:distance_m": np.array([0, 0, 0, 0, 0.012, 0.02]), "bound:distance_m": np.full(6, 0.05),
        "excess:speed_m_s": np.array([0, 0, 0, 0, 0, 0.25]), "bound:speed_m_s": np.full(6, 0.1),
        "excess:angle_deg": np.zeros(6), "bound:angle_deg": np.full(6, 5.0),
        "excess:drone_lost": np.array([0, 0, 0, 0, 1.0, 0]), "bound:drone_lost": np.full(6, np.nan),
    }  # fmt: skip
    return values | more


def test_reports_say_how_many_missed_what_and_by_how_much():
    report = make_report(load_config("hover"), 7, made(), {"best": made(success_rate=np.ones(6, bool))})
    told = json.loads(json.dumps(report["unsuccessful"], allow_nan=False))
    assert told["policy"] == {
        "episodes": 4,
        "failures": {"drone_collision": 1, "tilt": 1},
        "missed": {
            "distance_m": {"episodes": 2, "bound": 0.05, "median_excess": pytest.approx(0.016)},
            "speed_m_s": {"episodes": 1, "bound": 0.1, "median_excess": 0.25},
            "drone_lost": {"episodes": 1, "bound": None, "median_excess": None},
        },
        "unexplained": 0,
    }
    assert format_reasons(report, "hover").splitlines() == [
        "hover: 4 of 6 episodes without success",
        "  failures: drone collision 1, tilt 1",
        "  missed: distance in 2, bound 5 cm, by 1.6 cm (median)",
        "  missed: speed in 1, bound 0.1 m/s, by 0.25 m/s (median)",
        "  missed: drone lost in 1",
    ]


def test_a_card_tells_why_and_one_of_a_former_version_is_still_read():
    metrics = summarize(made())
    row = {"policies": {"policy": {"name": "p", "metrics": metrics}}, "paired": {}, "error": "payload_position_error_m"}
    card = {
        "tasks": {"hover": row}, "benchmark": "b", "suite": "s", "digest": "d" * 64, "seed": 1, "complete": True,
        "policy": {"name": "p"}, "episodes": 6,
    }  # fmt: skip
    assert "without success" not in format_card(card)
    row["policies"]["policy"]["unsuccessful"] = explain(made(), CAUSES)
    assert "hover: 4 of 6 episodes without success\n  failures: drone collision 1, tilt 1\n" in format_card(card)
