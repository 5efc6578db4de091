"""Evaluation: metrics by closed form, the same episodes at any batch size, the whole command."""

import json

import numpy as np
import pytest
from conftest import refusal

import multilift_marl as ml
from multilift_marl.agents.checkpoint import load_checkpoint, save_checkpoint
from multilift_marl.agents.policy import LearnedPolicy
from multilift_marl.agents.trainer import new_run
from multilift_marl.cli.evaluate import main as evaluate
from multilift_marl.config.load import build_config, load_config
from multilift_marl.envs.core import EVALUATION, MultiliftVec
from multilift_marl.evaluation import rollout
from multilift_marl.evaluation.metrics import bootstrap, compare, format_table, make_report, summarize, wilson
from multilift_marl.evaluation.rollout import run_episodes, trace_episode
from multilift_marl.policies.baselines import make_scripted

SCRIPTS = {  # those of every task
    "formation", "formation_integral", "formation_feedback", "formation_gusts", "payload_geometric",
}  # fmt: skip
CONTRACT = {
    "success_rate", "precise_rate", "payload_tilt_deg",
    "payload_position_error_m", "payload_attitude_error_deg", "payload_rmse_m", "settling_time_s",
    "return", "cable_tension_min_n", "cable_tension_max_n", "slack_time_s", "min_separation_m", "energy_j",
    "action_rate", "failure_ground_rate", "failure_diverged_rate",
}  # fmt: skip


def script(name):
    return lambda vec: make_scripted(name, vec)


@pytest.fixture(scope="module")
def flown():
    return run_episodes(load_config("hover"), script("formation_integral"), 12, seed=5)


def test_wilson_interval_matches_published_values():
    # Newcombe, Statistics in Medicine 17, 1998, table I: 81/263, 15/148, 0/20, 1/29
    published = (
        (81, 263, 0.2553, 0.3662),
        (15, 148, 0.0624, 0.1605),
        (0, 20, 0.0, 0.1611),
        (1, 29, 0.0061, 0.1718),
    )
    for successes, trials, low, high in published:
        np.testing.assert_allclose(wilson(successes, trials), (low, high), atol=6e-5)


def test_bootstrap_covers_the_mean_as_often_as_it_says():
    rng = np.random.default_rng(0)
    hits = sum(low <= 1.0 <= high for low, high in (bootstrap(rng.normal(1, 2, 60)) for _ in range(200)))
    assert 0.89 <= hits / 200 <= 0.99
    assert bootstrap(np.full(9, 3.0)) == (3.0, 3.0)


def test_summary_counts_failures_at_the_bound(flown):
    worse = {name: values.copy() for name, values in flown.items()}
    worse["success_rate"][:3], worse["failure_cause"][:3] = False, 1
    worse["payload_position_error_m"][:3] = 3.0
    summary = summarize(worse)
    assert set(summary) >= CONTRACT
    assert summary["success_rate"]["mean"] == 0.75
    assert summary["failure_ground_rate"]["mean"] == 0.25
    good = worse["payload_position_error_m"][3:].mean()
    assert summary["payload_position_error_m_successful"]["mean"] == pytest.approx(good)
    assert summary["payload_position_error_m"]["mean"] == pytest.approx((3 * 3.0 + 9 * good) / 12)


def test_errors_without_failures_and_of_successes_stand_apart(flown):
    mixed = {name: values.copy() for name, values in flown.items()}
    mixed["success_rate"][:] = True
    mixed["success_rate"][:4], mixed["failure_cause"][:3] = False, 1
    summary, tilt = summarize(mixed), mixed["payload_tilt_deg"]
    assert summary["payload_tilt_deg_held"]["mean"] == pytest.approx(tilt[3:].mean())
    assert summary["payload_tilt_deg_successful"]["mean"] == pytest.approx(tilt[4:].mean())
    mixed["failure_cause"][:] = 1
    assert "payload_tilt_deg_held" not in summarize(mixed)


def test_precise_episodes_err_by_a_centimetre_and_a_degree_at_most(flown):
    near = (flown["payload_position_error_m"] <= 0.01) & (flown["payload_attitude_error_deg"] <= 1.0)
    np.testing.assert_array_equal(flown["precise_rate"], near)
    assert 0 < near.mean() < 1 and (flown["payload_tilt_deg"] <= flown["payload_attitude_error_deg"] + 1e-9).all()
    assert summarize(flown)["precise_rate"] == {"mean": near.mean(), "ci95": list(wilson(int(near.sum()), 12))}


def test_no_success_leaves_out_what_has_no_mean(flown):
    none = {name: values.copy() for name, values in flown.items()}
    none["success_rate"][:] = False
    assert "settling_time_s_successful" not in summarize(none)


def test_paired_differences(flown):
    better = {name: values.copy() for name, values in flown.items()}
    better["return"] = flown["return"] + 2.5
    paired = compare(better, flown)
    assert paired["return"]["mean"] == pytest.approx(2.5)
    assert paired["return"]["ci95"] == pytest.approx([2.5, 2.5])
    assert paired["energy_j"]["mean"] == 0


def test_episodes_do_not_depend_on_the_batch_size(flown, monkeypatch):
    monkeypatch.setattr(rollout, "_BATCH", 5)
    again = run_episodes(load_config("hover", {"env.num_threads": 1}), script("formation_integral"), 12, seed=5)
    for name, values in flown.items():
        np.testing.assert_array_equal(values, again[name], err_msg=name)


def test_other_seeds_and_purposes_are_other_episodes(flown):
    other = run_episodes(load_config("hover"), script("formation_integral"), 12, seed=6)
    training = run_episodes(load_config("hover"), script("formation_integral"), 12, seed=5, purpose=0)
    assert not np.isin(flown["return"], other["return"]).any()
    assert not np.isin(flown["return"], training["return"]).any()


def test_trace_is_the_same_flight(flown):
    config = load_config("hover")
    trace = trace_episode(config, script("formation_integral"), 3, seed=5)
    assert trace.time[-1] == pytest.approx(8.0)
    assert trace.distance[-100:].mean() == pytest.approx(flown["payload_position_error_m"][3], rel=1e-12)
    assert trace.angle[-100:].mean() == pytest.approx(flown["payload_attitude_error_deg"][3], rel=1e-12)
    error = np.linalg.norm(trace.payload_position - trace.target_position, axis=1)
    np.testing.assert_allclose(trace.distance, error, rtol=1e-12)
    outside = trace.time[trace.distance > 0.05]
    assert flown["settling_time_s"][3] == pytest.approx(outside.max() if len(outside) else 0.0)
    assert trace.drone_position.shape == (400, 4, 3) and trace.tension.shape == (400, 4)


def test_errors_along_the_axes_of_the_target_add_up(flown):
    parts = [flown[f"payload_rmse_{axis}_m"] for axis in "xyz"]
    np.testing.assert_allclose(np.sqrt(np.square(parts).sum(axis=0)), flown["payload_rmse_m"], rtol=1e-12)
    still = {f"task_options.{key}": 0.0 for key in ("start_radius", "start_tilt", "start_speed")}
    calm = {"randomization.payload_mass": 0.0, "randomization.payload_force": 0.0, "wind.velocity": [5.0, 0.0, 0.0]}
    config = load_config("hover", still | calm)
    vec = MultiliftVec(build_config(config.model_dump(), {"env.num_envs": 6}), EVALUATION)
    vec.reset(seed=1000)
    blown = run_episodes(config, script("formation"), 6, seed=1000)
    for across, along in (("y_m", "x_m"), ("roll_deg", "pitch_deg")):
        share = blown[f"payload_rmse_{across}"] / blown[f"payload_rmse_{along}"] / np.abs(np.tan(vec.task.goal.yaw))
        np.testing.assert_allclose(share, share[0], rtol=0.03)  # not 1: drag and stiffness differ along the two
        assert 0.5 < share[0] < 1.5
    assert (blown["payload_rmse_yaw_deg"] < 0.1 * blown["payload_attitude_error_deg"]).all()


def test_energy_of_a_hovering_team_is_its_rotors_power_times_time():
    options = {f"task_options.{key}": 0.0 for key in ("start_radius", "start_tilt", "start_speed")}
    calm = {"randomization.payload_mass": 0.0, "randomization.payload_force": 0.0, "env.episode_seconds": 2.0}
    config = load_config("hover", options | calm)
    episodes = run_episodes(config, script("formation"), 2, seed=0)
    vehicle, system = config.system.vehicle, config.system
    thrust = np.linalg.norm(system.formation_force + [0, 0, vehicle.mass * 9.81], axis=1)
    speed = np.sqrt(thrust / 4 / vehicle.thrust_coefficient)
    power = (vehicle.torque_ratio * thrust * speed).sum()
    np.testing.assert_allclose(episodes["energy_j"], 2.0 * power, rtol=1e-3)
    np.testing.assert_allclose(episodes["cable_tension_min_n"], np.linalg.norm(system.formation_force[0]), rtol=1e-3)
    assert (episodes["slack_time_s"] == 0).all() and (episodes["action_rate"] == 0).all()


def test_evaluation_seeds_are_the_contracts():
    vec = MultiliftVec(load_config("hover", {"env.num_envs": 1}), EVALUATION, first_env=7)
    vec.reset(seed=1000)
    rng = np.random.Generator(np.random.PCG64(np.random.SeedSequence(1000, spawn_key=(2, 7, 0))))
    factor = rng.uniform(-1, 1)
    assert vec.world.hidden_loads.payload_mass[0] == pytest.approx(1.4 * (1 + 0.2 * factor), rel=1e-12)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    small = {"env.num_envs": 4, "train.horizon": 8, "train.frames": 64, "eval.episodes": 2, "eval.every": 1}
    config = load_config("hover", small)
    trainer = new_run(config, "hover", tmp_path_factory.mktemp("runs"))
    trainer.run()
    return trainer.folder


@pytest.mark.slow
def test_command_writes_metrics_plots_and_table(run, tmp_path, capsys):
    arguments = [f"run={run}", "episodes=10", "seed=1000", f"out={tmp_path}", "env.num_drones=3", "payload.mass=1.2"]
    assert evaluate(arguments) == 0
    shown = capsys.readouterr().out
    for word in ("success", "position error", "attitude error", "settling time", "formation_integral"):
        assert word in shown
    report = json.loads((tmp_path / "metrics.json").read_text())
    assert report["episodes"] == 10 and report["seed"] == 1000
    assert report["config"]["env"]["num_drones"] == 3 and report["config"]["payload"]["mass"] == 1.2
    assert set(report["baselines"]) == SCRIPTS == set(report["paired"])
    for summary in (report["policy"], *report["baselines"].values()):
        assert set(summary) >= CONTRACT
        for name, value in summary.items():
            if value["ci95"] is None:  # of fewer than ten episodes
                assert name.endswith(("_held", "_successful")) or name == "settling_time_s"
            else:
                assert value["ci95"][0] <= value["mean"] <= value["ci95"][1]
    assert {"errors.png", "tensions.png", "paths.png", "training.png"} <= {path.name for path in tmp_path.iterdir()}


def test_command_flies_a_script_in_place_of_a_policy(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    short = ["episodes=2", "env.episode_seconds=0.4"]
    assert evaluate(["policy=formation", "baseline=payload_geometric", "config=pose_easy", *short]) == 0
    shown = capsys.readouterr().out
    assert "formation on pose_easy: 2 episodes" in shown
    (folder,) = (tmp_path / "runs" / "formation-pose_easy" / "eval").iterdir()
    report = json.loads((folder / "metrics.json").read_text())
    assert report["config"]["task"] == "pose" and set(report["baselines"]) == SCRIPTS - {"formation"}
    why = {"formation": report["unsuccessful"]["policy"], **report["unsuccessful"]["baselines"]}
    assert why.keys() == SCRIPTS and why["formation"]["episodes"] == 2 - 2 * report["policy"]["success_rate"]["mean"]
    for name, each in why.items():
        assert (f"{name}: {each['episodes']} of 2 episodes without success\n  missed: " in shown) == bool(
            each["missed"]
        )
    assert {"errors.png", "tensions.png", "paths.png"} <= {path.name for path in folder.iterdir()}


@pytest.mark.slow
def test_the_script_of_an_interface_is_its_baseline(tmp_path):
    short = ["episodes=2", "env.episode_seconds=0.4", f"out={tmp_path}"]
    assert evaluate(["run=hover_ctbr", *short]) == 0
    report = json.loads((tmp_path / "metrics.json").read_text())
    assert set(report["baselines"]) == {"hold_ctbr"}
    assert evaluate(["policy=formation", "config=hover", *short]) == 0
    assert "formation_integral" in json.loads((tmp_path / "metrics.json").read_text())["baselines"]


@pytest.mark.slow
def test_a_run_on_another_rig_is_a_policy_on_it(tmp_path):
    (tmp_path / "rig.yaml").write_text("base: hover\npayload: {mass: 1.1}\nenv: {episode_seconds: 0.4}\n")
    reports = []
    for key in ("run", "policy"):
        out = tmp_path / key
        asked = [f"{key}=hover", f"config={tmp_path / 'rig.yaml'}", "episodes=2", "baseline=none", f"out={out}"]
        assert evaluate([*asked, "plots=pdf"]) == 0
        reports.append(json.loads((out / "metrics.json").read_text()))
        for name in ("errors", "tensions", "paths"):
            assert (out / f"{name}.pdf").read_bytes().startswith(b"%PDF") and (out / f"{name}.png").is_file()
    assert reports[0] == reports[1] and reports[0]["config"]["payload"]["mass"] == 1.1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["policy=hovr"], "unknown policy 'hovr'; did you mean 'hover'?"),
        (["policy=formatoin"], "unknown policy 'formatoin'; did you mean 'formation'?"),
        (["policy=formation", "run=latest"], "policy=formation takes the place of a run and has no run"),
        (["policy=formation", "checkpoint=last"], "policy=formation takes the place of a run and has no checkpoint"),
        (["config=hover"], "config=hover says where to fly, but not who does: add run="),
        (["run=nobody", "config=pose_eas"], "no configuration named 'pose_eas'; did you mean 'pose_easy'?"),
        (
            ["run=hover", "config=pose_easi.yaml"],
            "no configuration file pose_easi.yaml: give the path of a YAML file or a "
            "shipped name; did you mean 'pose_easy'?",
        ),
        (["run=hover", "config=pose_eas"], "no configuration named 'pose_eas'; did you mean 'pose_easy'?"),
        (["run=hover", "config=rigs/falcn3"], "no configuration named 'rigs/falcn3'; did you mean 'rigs/falcon3'?"),
        (["run=hover", "config=pose"], "was trained in task hover and cannot fly this pose: number 50 of the"),
        (["policy=pose_easy"], "policy=pose_easy is a recipe that no shipped policy was trained by; train one by"),
        (["run=gate_two"], "or fly a baseline in it by policy=formation config=gate_two"),
        (["policy=formation", "config=pose_eas"], "no configuration named 'pose_eas'; did you mean 'pose_easy'?"),
        (["policy=formation", "control.action=ctbr", "baseline=none"], "cannot fly control.action=ctbr"),
        (["policy=hold_ctbr", "baseline=formation", "control.action=ctbr"], "take baseline=hold_ctbr, set"),
    ],
)
def test_command_line_errors_of_scripts(capsys, arguments, message):
    assert evaluate(arguments) == 2
    assert message in capsys.readouterr().err


@pytest.mark.slow
def test_command_films_the_first_episode(run, tmp_path):
    import imageio.v3 as iio

    settings = ["episodes=1", "video=true", "baseline=none", "env.episode_seconds=0.4", f"out={tmp_path}"]
    assert evaluate([f"run={run}", *settings]) == 0
    frames = iio.imread(tmp_path / "episode_0.mp4")
    assert len(frames) == 11 and frames.std() > 10


@pytest.mark.slow
def test_command_films_from_the_camera_asked_for(run, tmp_path, monkeypatch):
    from multilift_marl import rendering

    asked = []
    plain = rendering.Renderer
    monkeypatch.setattr(rendering, "Renderer", lambda vec, **how: asked.append(how) or plain(vec, 64, 36, **how))
    settings = ["episodes=1", "video=true", "baseline=none", "env.episode_seconds=0.1", f"out={tmp_path}"]
    assert evaluate([f"run={run}", *settings]) == 0
    assert evaluate([f"run={run}", *settings, "camera=chase", "trail=0.5"]) == 0
    assert asked == [{"camera": "side", "trail": 2.0}, {"camera": "chase", "trail": 0.5}]


@pytest.mark.slow
def test_without_graphics_evaluation_goes_on(run, tmp_path, monkeypatch, capsys):
    from multilift_marl import rendering
    from multilift_marl.errors import RenderingError

    def no_graphics(*arguments, **keywords):
        raise RenderingError("no graphics here")

    monkeypatch.setattr(rendering, "Renderer", no_graphics)
    assert evaluate([f"run={run}", "episodes=1", "video=true", "env.episode_seconds=0.4", f"out={tmp_path}"]) == 0
    assert "no video: no graphics here" in capsys.readouterr().err
    assert (tmp_path / "metrics.json").is_file() and (tmp_path / "errors.png").is_file()


@pytest.mark.parametrize(
    ("argument", "message"),
    [
        ("baseline=formatoin", "unknown baseline 'formatoin'; did you mean 'formation'?"),
        ("episodes=0", "episodes must be from 1 to 1e+06, but is 0"),
        ("episodes=many", "episodes must be a whole number, but is 'many'"),
        ("video=perhaps", "video must be a valid boolean"),
        ("camera=sid", "camera must be 'side', 'top' or 'chase', but is 'sid'"),
        ("trail=long", "trail must be a number, but is 'long'"),
        ("trail=-1", "trail must be from 0 to 1000 s, but is -1"),
        ("checkpoint=none.pt", "no checkpoint none.pt"),
        (
            "control.action=ctbr",
            "cannot fly ctbr; set control.action=reference",
        ),
        ("control.action=velocity", "was trained with control.action=reference and cannot fly velocity"),
        ("task=track", "was trained in task hover and cannot fly this track: number"),
        ("payload.mas=1", "unknown key 'payload.mas'; did you mean 'payload.mass'?"),
        ("out=/dev/null", "cannot write into /dev/null (File exists); give another folder by out=<folder>"),
        ("out=/dev/null/x", "cannot write into /dev/null/x (Not a directory); give another folder"),
        ("checkpoint=/dev/null", "no checkpoint /dev/null"),
        ("episods=3", "unknown key 'episods'; did you mean 'episodes'?"),
    ],
)
def test_command_line_errors(run, capsys, argument, message):
    assert evaluate([f"run={run}", argument]) == 2
    assert message in capsys.readouterr().err
    assert not (run / "eval").exists()


def test_a_policy_of_the_same_size_but_another_meaning_is_refused(run, tmp_path, capsys):
    content = load_checkpoint(run / "checkpoints" / "last.pt")
    content["action_names"][3] = "yaw_rate"
    save_checkpoint(tmp_path / "old.pt", content)
    assert evaluate([f"run={run}", f"checkpoint={tmp_path / 'old.pt'}"]) == 2
    assert "number 3 of the actions is yaw_rate there and yaw here" in capsys.readouterr().err
    fast = ml.make_vec("hover", num_envs=1, **{"control.action": "acceleration"})
    slow = ml.load_config("hover", {"control.action": "velocity"}).model_dump(mode="json")
    policy = LearnedPolicy(content | {"config": slow, "action_names": list(fast.action_names)}, "mine")
    message = "the policy of mine was trained with control.action=velocity and cannot fly acceleration"
    assert policy.action_names == fast.action_names and message in refusal(policy.bind, fast)


@pytest.mark.slow
def test_shipped_policy_beats_the_scripts(tmp_path):
    policy = ml.load_policy("hover")
    flights = {
        name: run_episodes(load_config("hover"), maker, 64, seed=4321)
        for name, maker in {"policy": lambda vec: policy, "script": script("formation_integral")}.items()
    }
    report = make_report(policy.config, 4321, flights["policy"], {"script": flights["script"]})
    assert report["policy"]["success_rate"]["mean"] >= 0.95
    assert report["policy"]["payload_position_error_m"]["mean"] <= 0.01
    assert report["paired"]["script"]["return"]["ci95"][0] > 0
    table = format_table(report)
    assert "success" in table and "clearance" not in table  # of a task without obstacles
