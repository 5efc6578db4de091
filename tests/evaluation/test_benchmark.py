"""The benchmark: its suites are fixed, a card's numbers are those of evaluate.py, what cannot be flown is listed."""

from __future__ import annotations

import hashlib
import importlib
import json
import shlex
from pathlib import Path

import numpy as np
import pytest
import yaml
from conftest import ALL, refusal

from multilift_marl._versions import find_versions
from multilift_marl.agents.policy import load_policy
from multilift_marl.cli import benchmark as command
from multilift_marl.cli.benchmark import main as benchmark
from multilift_marl.cli.evaluate import main as evaluate
from multilift_marl.config import load as loading
from multilift_marl.config.load import build_config, config_dir, load_config
from multilift_marl.envs.core import EVALUATION, MultiliftVec
from multilift_marl.evaluation import plots, suites
from multilift_marl.evaluation.rollout import measure_episodes, run_episodes
from multilift_marl.evaluation.suites import SUITES, list_shifts, load_suite
from multilift_marl.policies.baselines import make_scripted
from multilift_marl.sim.parameters import Parameters

DIGESTS = {
    "standard": "05a96dd8ea1a7f0b9b46e5e2b2534a4b2ba9b90f4c48db2b853ad90f47d47beb",
    "realistic": "d68c8f63a52b9b5fbb0ef57a662119d96b1b94b19b2d8868d78059014ea730b2",
    "shifts": "c8d87c579f44c98258f316f43148038c6c5365d9976a4e90c3bbdeea67139511",
}
"""Of multilift-bench v1, for good: if another one is found, what is evaluated has changed, and that is a version 2."""


@pytest.fixture
def short(monkeypatch):
    """Let a suite be `hover`, beside its baseline alone, and `land`, which a policy of `hover` cannot fly."""
    whole = load_suite("standard")
    tasks = {task.name: task for task in whole.tasks}
    hover = tasks["hover"]._replace(config=load_config("hover", {"env.episode_seconds": 0.4}), shipped=None)
    land = tasks["land"]._replace(config=load_config("land", {"env.episode_seconds": 2.0}), shipped=None)
    suite = whole._replace(tasks=(hover, land, hover._replace(name="again")), episodes=2)
    monkeypatch.setattr(command, "load_suite", lambda name: suite)
    monkeypatch.setattr(plots, "_save", lambda *arguments: None)  # most of the time
    return suite


def read(folder):
    return json.loads((folder / "card.json").read_text(encoding="utf-8"))


@pytest.mark.parametrize("name", SUITES)
def test_suites_of_version_1_stay_as_they_are(name):
    suite = load_suite(name)
    assert suite.digest == DIGESTS[name]
    assert suite.title == "multilift-bench v1"
    assert len({task.name for task in suite.tasks}) == len(suite.tasks) >= 8


def test_a_changed_configuration_is_not_version_1(tmp_path, monkeypatch):
    for path in config_dir().glob("*.yaml"):
        (tmp_path / path.name).write_bytes(path.read_bytes())
    monkeypatch.setattr(loading, "config_dir", lambda: tmp_path)
    assert load_suite("standard").title == "multilift-bench v1"
    land = yaml.safe_load((tmp_path / "land.yaml").read_text(encoding="utf-8"))
    land.setdefault("train", {})["frames"] = 7  # says nothing of an evaluation
    (tmp_path / "land.yaml").write_text(yaml.safe_dump(land), encoding="utf-8")
    assert load_suite("standard").title == "multilift-bench v1"
    land.setdefault("payload", {})["mass"] = 0.9
    (tmp_path / "land.yaml").write_text(yaml.safe_dump(land), encoding="utf-8")
    changed = load_suite("standard")
    assert changed.title == "multilift-bench v1, modified" and changed.digest != DIGESTS["standard"]


@pytest.mark.parametrize("change", ["seed", "episodes", "factors"])
def test_a_changed_definition_is_not_version_1(change, monkeypatch):
    content = json.loads(json.dumps(suites._read()))
    if change == "seed":
        content["seed"] += 1
    elif change == "episodes":
        content["suites"]["shifts"]["episodes"] += 1
    else:
        content["shifts"]["payload 35 % heavier"]["factors"]["payload_mass"] = 1.34
    monkeypatch.setattr(suites, "_read", lambda: content)
    assert load_suite("shifts").title.endswith(", modified")


def test_shifts_are_of_a_team_of_that_size():
    shifts = {shift.title: shift for shift in list_shifts(5)}
    numbers = [shifts[f"one drone {which}"].overrides["env.num_drones"] for which in ("less", "more")]
    assert numbers == [4, 6]
    assert shifts["one drone 15 % weaker"].factors == {"vehicle_thrust_coefficient": [0.85, 1, 1, 1, 1]}
    assert next(iter(shifts.values())).overrides == {}


def test_factors_fix_hidden_parameters_at_shares_of_the_nominal():
    config = load_config("hover", {"env.num_envs": 3, "env.num_threads": 1, "env.episode_seconds": 0.4})

    def script(vec):
        return make_scripted("formation", vec)

    vec = MultiliftVec(config, EVALUATION)
    mass = float(vec.world.parameters.payload_mass[0])
    observation, _ = vec.reset(seed=3, options={"randomization": {"payload_mass": 1.35 * mass}})
    expected = measure_episodes(vec, script(vec), observation)
    heavier = run_episodes(config, script, 3, seed=3, factors={"payload_mass": 1.35})
    usual = run_episodes(config, script, 3, seed=3)
    for name, values in expected.items():
        np.testing.assert_array_equal(heavier[name], values, err_msg=name)
    assert not np.isin(heavier["return"], usual["return"]).any()


@pytest.mark.parametrize("name", [name for name in Parameters._fields if name != "payload_center_of_mass"])
def test_a_factor_is_of_the_nominal_value_whatever_its_unit(name):
    config, seen = load_config("hover", {"env.num_threads": 1, "env.episode_seconds": 0.02}), []

    def script(vec):
        seen.append(np.array(getattr(vec.world.parameters, name)))
        return make_scripted("formation", vec)

    config = build_config(config.model_dump(), ALL | {f"randomization.{name}": 0.3, "payload.mass": 0.5})
    nominal = getattr(MultiliftVec(config, EVALUATION).world.parameters, name)[:1]
    run_episodes(config, script, 1, seed=3, factors={name: 1.25})
    np.testing.assert_allclose(seen[0], 1.25 * nominal, rtol=1e-12)


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("wind", "factors has no 'wind'; known: "),
        ("payload_center_of_mass", "factors has no 'payload_center_of_mass'"),
        ("vehicle_masss", "factors has no 'vehicle_masss'; did you mean 'vehicle_mass'?"),
    ],
)  # fmt: skip
def test_what_is_no_factor_is_refused(name, said):
    config = load_config("hover", {"env.num_threads": 1, "env.episode_seconds": 0.02})
    message = refusal(run_episodes, config, lambda vec: make_scripted("formation", vec), 1, 3, factors={name: 1.0})
    assert message.startswith(said)


@pytest.mark.slow
def test_numbers_of_a_card_are_those_of_evaluate(short, tmp_path, capsys):
    assert benchmark(["policy=formation_feedback", f"out={tmp_path / 'card'}"]) == 0
    shown = capsys.readouterr().out
    card = read(tmp_path / "card")
    row = card["tasks"]["hover"]
    same = ["config=hover", "env.episode_seconds=0.4", "episodes=2", f"seed={short.seed}", "baseline=none"]
    reports = []
    for policy in ("formation_feedback", "multilift_marl.policies.tuned:HoverRigs"):
        assert evaluate([f"policy={policy}", *same, f"out={tmp_path}"]) == 0
        reports.append(json.loads((tmp_path / "metrics.json").read_text()))
    for label, name, report in zip(("policy", "baseline"), ("formation_feedback", "hover_rigs"), reports, strict=True):
        why = report["unsuccessful"]["policy"]
        assert row["policies"][label] == {"name": name, "metrics": report["policy"], "unsuccessful": why}
        assert why["episodes"] == 2 and why["missed"]["time_held_s"]["bound"] == 0.4
    reports = [report["policy"] for report in reports]
    for name, value in row["paired"]["baseline"].items():
        assert value["mean"] == pytest.approx(reports[0][name]["mean"] - reports[1][name]["mean"], abs=1e-12)
        assert value["ci95"] is None
    assert card["complete"] and card["digest"] == short.digest and card["policy"]["brings"] == {}
    table = (tmp_path / "card" / "table.md").read_text(encoding="utf-8")
    assert table.strip() in shown and "| hover " in table and "\nhover: 2 of 2 episodes without success\n" in table


def test_the_picture_has_a_bar_for_each_policy_of_each_task_that_was_flown(short, tmp_path, monkeypatch):
    figures = []
    monkeypatch.setattr(plots, "_save", lambda figure, *_: figures.append(figure))
    assert benchmark(["policy=hover", f"out={tmp_path}"]) == 0
    card = read(tmp_path)
    success, error = figures[0].axes
    assert [label.get_text() for label in success.get_yticklabels()] == list(card["tasks"])
    for axes, metric in ((success, "success_rate"), (error, "payload_position_error_m")):
        found = [bar.get_width() / 100 for bar in axes.patches]
        means = [
            card["tasks"][task]["policies"][label]["metrics"][metric]["mean"]
            for label in ("policy", "baseline")
            for task in ("hover", "again")
        ]
        np.testing.assert_allclose(found, means)
    assert [text.get_text() for text in success.texts] == ["not applicable"]
    plots.plot_card(tmp_path / "none.png", card | {"tasks": {}})  # stopped before anything was flown


def test_what_a_policy_cannot_fly_is_listed_with_the_reason(short, tmp_path):
    assert benchmark(["policy=hover", f"out={tmp_path}"]) == 0
    card = read(tmp_path)
    assert list(card["tasks"]) == ["hover", "land", "again"]  # in the suite's order
    assert card["tasks"]["land"]["not_applicable"].startswith("was trained in task hover and cannot fly this land")
    assert card["tasks"]["land"]["not_applicable"] in (tmp_path / "table.md").read_text(encoding="utf-8")
    assert set(card["tasks"]["hover"]["policies"]) == {"policy", "baseline"}
    assert card["complete"]
    brought = load_policy("hover").config
    assert card["policy"]["brings"]["control"] == brought.control.model_dump(mode="json")
    assert len(card["policy"]["sha256"]) == 64


@pytest.mark.slow
def test_a_policy_brings_its_action_interface(short, tmp_path):
    assert benchmark(["policy=hover_ctbr", f"out={tmp_path}"]) == 0
    metrics = read(tmp_path)["tasks"]["hover"]["policies"]["policy"]["metrics"]
    config = load_config("hover_ctbr", {"env.episode_seconds": 0.4})
    flown = run_episodes(config, load_policy("hover_ctbr").bind, 2, short.seed)
    assert metrics["return"]["mean"] == flown["return"].mean()
    assert benchmark(["policy=hold_ctbr", "control.action=ctbr", f"out={tmp_path / 'hold'}"]) == 0
    assert read(tmp_path / "hold")["policy"]["brings"] == {"control.action": "ctbr"}


def test_shipped_policies_and_baselines_are_not_flown_twice(short, tmp_path, monkeypatch):
    both = short._replace(tasks=(short.tasks[0]._replace(shipped="hover", baseline="formation"),))
    monkeypatch.setattr(command, "load_suite", lambda name: both)
    for name, beside in (
        ("formation_feedback", ["baseline", "shipped"]),
        ("hover", ["baseline"]),
        ("formation", ["shipped"]),
    ):
        assert benchmark([f"policy={name}", f"out={tmp_path / name}"]) == 0
        assert list(read(tmp_path / name)["tasks"]["hover"]["paired"]) == beside


def test_ctrl_c_keeps_what_is_done_and_the_same_folder_goes_on(short, tmp_path, capsys, monkeypatch):
    flown, real = [], command.fly

    def stopped(config, make, name, *others):
        flown.append(name)
        if name.startswith("again"):
            raise KeyboardInterrupt
        return real(config, make, name, *others)

    monkeypatch.setattr(command, "fly", stopped)
    out = tmp_path / "card"
    assert benchmark(["policy=formation", f"out={out}", "control.max_yaw=0.4"]) == 130
    said = capsys.readouterr().err.splitlines()[-1]
    assert "stopped after 2 of 3 tasks; go on by: python -m multilift_marl.benchmark " in said
    again = shlex.split(said.partition("multilift_marl.benchmark ")[2])
    assert sorted(again) == sorted(["policy=formation", "episodes=2", f"out={out}", "control.max_yaw=0.4"])
    part = read(out)
    assert not part["complete"] and "again" not in part["tasks"] and part["tasks"]["hover"]["policies"]
    monkeypatch.setattr(command, "fly", real)
    flown.clear()
    assert benchmark(again) == 0
    whole = read(out)
    assert whole["complete"] and whole["tasks"]["hover"] == part["tasks"]["hover"]
    assert whole["tasks"]["again"]["policies"] == whole["tasks"]["hover"]["policies"]  # the same episodes
    assert list(whole["tasks"]) == ["hover", "land", "again"]


def test_a_policy_that_raises_leaves_what_is_done_and_how_to_go_on(short, tmp_path, capsys, monkeypatch):
    real = command.fly

    def fail(config, make, name, *others):
        if name.startswith("again"):
            raise RuntimeError("solver diverged")
        return real(config, make, name, *others)

    monkeypatch.setattr(command, "fly", fail)
    out = tmp_path / "card"
    with pytest.raises(RuntimeError, match="solver diverged"):
        benchmark(["policy=formation", f"out={out}"])
    said = capsys.readouterr()
    assert said.out.splitlines()[0].endswith(f"2 episodes of each task, into {out}")
    assert f"wrote card.json, table.md and card.png in {out}" in said.out
    again = said.err.splitlines()[-1].partition("after 2 of 3 tasks; go on by: python -m multilift_marl.benchmark ")[2]
    assert sorted(shlex.split(again)) == sorted(["policy=formation", "episodes=2", f"out={out}"])
    assert list(read(out)["tasks"]) == ["hover", "land"] and not read(out)["complete"]
    assert "| hover " in (out / "table.md").read_text(encoding="utf-8")


def test_a_cluster_that_cannot_be_joined_is_refused_in_a_sentence_alone(short, tmp_path, capsys):
    assert benchmark(["policy=formation", "workers=1", "ray=nowhere", f"out={tmp_path}"]) == 2
    assert capsys.readouterr().err.splitlines() == [
        "error: ray=nowhere is no host:port of a Ray cluster's head node; give one, local or auto"
    ]


@pytest.mark.parametrize("name", ["kit_of_policies:P", "multilift_marl.policies.tuned:HoverRigs"])
def test_a_card_knows_the_file_of_an_installed_policy(name, short, tmp_path, capsys, monkeypatch, registries):
    (tmp_path / "site").mkdir()
    kit, out = tmp_path / "site" / "kit_of_policies.py", tmp_path / "card"
    kit.write_text("from multilift_marl.policies.formation import Formation as P\n")
    monkeypatch.syspath_prepend(str(kit.parent))
    monkeypatch.chdir(tmp_path)
    assert benchmark([f"policy={name}", f"out={out}"]) == 0
    file = Path(importlib.import_module(name.partition(":")[0]).__file__)
    assert read(out)["policy"]["sha256"] == hashlib.sha256(file.read_bytes()).hexdigest()
    if file == kit:
        kit.write_text(kit.read_text() + "# changed\n")
        assert benchmark([f"policy={name}", f"out={out}"]) == 2
        assert "is of another evaluation, its policy differs" in capsys.readouterr().err


def test_an_earlier_card_goes_on_and_says_what_is_not_known_of_it(short, tmp_path, capsys):
    arguments = ["policy=multilift_marl.policies.tuned:HoverRigs", f"out={tmp_path}"]
    assert benchmark(arguments) == 0
    card = read(tmp_path)
    del card["versions"]["sources"], card["tasks"]["again"]
    card["policy"]["sha256"] = None
    (tmp_path / "card.json").write_text(json.dumps(card), encoding="utf-8")
    capsys.readouterr()
    for _ in range(2):
        assert benchmark(arguments) == 0
        shown = capsys.readouterr().out
        for what in ("sources of versions", "sha256 of policy"):
            assert f"note: {tmp_path / 'card.json'} does not say {what}, so its rows may be of other code" in shown
    whole = read(tmp_path)
    assert whole["versions"] == find_versions() | {"sources": None} and whole["policy"]["sha256"] is None
    assert whole["complete"] and whole["tasks"]["hover"] == card["tasks"]["hover"]


def test_a_policy_that_was_trained_at_another_rate_is_warned_of(short, tmp_path, caplog):
    from multilift_marl.agents.checkpoint import load_checkpoint, save_checkpoint

    content = load_checkpoint(command._SHIPPED / "hover.pt")
    content["config"]["env"]["policy_hz"] = 125.0
    save_checkpoint(tmp_path / "fast.pt", content)
    for name, warned in ((tmp_path / "fast.pt", True), ("hover", False)):
        caplog.clear()
        assert benchmark([f"policy={name}", f"out={tmp_path / 'card'}{warned}"]) == 0
        warning = (
            "was configured with env.policy_hz=125.0; the values here change what its actions and observations mean"
        )
        assert (f"the policy of {name} {warning}" in caplog.messages) == warned
        row = read(tmp_path / f"card{warned}")["tasks"]["hover"]["policies"]
        assert row["policy"].get("warning") == (warning if warned else None) and "warning" not in row["baseline"]
        table = (tmp_path / f"card{warned}" / "table.md").read_text(encoding="utf-8")
        assert (f"\n- hover: {name} {warning}\n" in table) == warned


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "give policy="),
        (["policy=hovr"], "unknown policy 'hovr'; did you mean 'hover'?"),
        (["policy=hover", "suite=hard"], "suite"),
        (["policy=hover", "episodes=0"], "episodes"),
        (["policy=hover", "payload.mass=2.0"], "the tasks of multilift-bench are fixed: leave out payload.mass"),
        (["policy=hover", "seed=3"], "the tasks of multilift-bench are fixed: leave out seed"),
        (["policy=formation", "control.actoin=ctbr"], "control.actoin"),
        (
            ["policy=formation", "control.action=ctbr"],
            "the baseline 'formation' acts by control.action=reference",
        ),
        (["policy=hold_ctbr:Missing"], "no such module"),
        (["policy=track_realistic"], "can fly no task of suite=standard; hover: was trained in task track"),
        (["policy=missing.pt"], "missing.pt"),
    ],
)
def test_what_cannot_be_is_refused_in_one_sentence_before_any_work(
    arguments, message, short, tmp_path, capsys, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(command, "fly", None)
    assert benchmark(arguments) == 2
    shown = capsys.readouterr().err
    assert message in shown and shown.startswith("error: ") and shown.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_the_card_of_another_evaluation_is_not_gone_on_with(short, tmp_path, capsys, monkeypatch):
    assert benchmark(["policy=formation", f"out={tmp_path}"]) == 0
    before = (tmp_path / "card.json").read_bytes()
    capsys.readouterr()
    monkeypatch.setattr(command, "fly", None)
    assert benchmark(["policy=formation", "episodes=3", f"out={tmp_path}"]) == 2
    assert "is of another evaluation, its episodes differs" in capsys.readouterr().err
    assert benchmark(["policy=formation_feedback", f"out={tmp_path}"]) == 2
    assert "its policy differs" in capsys.readouterr().err
    assert read(tmp_path)["versions"] == find_versions()
    monkeypatch.setattr(command, "find_versions", lambda: find_versions() | {"sources": "0" * 16})
    assert benchmark(["policy=formation", f"out={tmp_path}"]) == 2
    assert "its versions differs" in capsys.readouterr().err
    assert (tmp_path / "card.json").read_bytes() == before
    (tmp_path / "card.json").write_text("{")
    assert benchmark(["policy=formation", f"out={tmp_path}"]) == 2
    assert "is no card to go on with" in capsys.readouterr().err


def test_a_file_that_names_a_strangers_module_is_refused(short, tmp_path, capsys, registries):
    from multilift_marl.agents.checkpoint import load_checkpoint, save_checkpoint

    (tmp_path / "stranger.py").write_text("raise SystemExit('ran')")
    content = load_checkpoint(command._SHIPPED / "hover.pt")
    content["config"] = content["config"] | {"import": str(tmp_path / "stranger.py")}
    save_checkpoint(tmp_path / "theirs.pt", content)
    assert benchmark([f"policy={tmp_path / 'theirs.pt'}"]) == 2
    assert "trust=true" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize("name", SUITES)
def test_the_policies_beside_fly_every_task(name):
    contenders, refused = command._check(load_suite(name), "formation", command.find_policy("formation"), {})
    assert refused == {}
    for teams in contenders.values():
        for team in teams.values():
            vec = MultiliftVec(loading.build_config(team.config.model_dump(), {"env.num_envs": 1}))
            observation, _ = vec.reset(seed=0)
            vec.step(team.make(vec).act(observation))
