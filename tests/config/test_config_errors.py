"""Configurations: which names, values, files and command lines are refused, and how it is said."""

from __future__ import annotations

import math
import os
import random
import re

import pytest
from conftest import refusal, refuse_system, refuse_task

import multilift_marl as ml
from multilift_marl.config.load import config_dir, dump_config, load_config, parse_overrides
from multilift_marl.errors import ConfigError


def refuse_values(**overrides) -> str:
    return refusal(load_config, "hover", {key.replace("__", "."): value for key, value in overrides.items()})


# Names


@pytest.mark.parametrize(
    "key, nearest",
    [
        ("sed", "seed"),
        ("randomisation", "randomization"),
        ("env.num_dronez", "env.num_drones"),
        ("sim.time_step", "sim.timestep"),
        ("payload.mas", "payload.mass"),
        ("cable.stifness", "cable.stiffness"),
        ("train.learningrate", "train.learning_rate"),
        ("eval.episode", "eval.episodes"),
        ("train.steps", "train.frames"),  # as other libraries call it
        ("env.n_agents", "env.num_drones"),
    ],
)
def test_unknown_key_names_the_nearest(key, nearest):
    message = refuse_values(**{key: 1})
    assert re.fullmatch(rf"unknown key '{re.escape(key)}'.*did you mean '{nearest}'\?", message)


@pytest.mark.parametrize(
    "name, hint",
    [
        ("num_dron", "did you mean 'num_drones'?"),  # an argument of the call itself
        ("frames", "did you mean 'train.frames'?"),  # a key of a section
        ("mas", "did you mean 'vehicle.mass' or 'payload.mass'?"),
        ("randomisation", "did you mean 'randomization'?"),
        ("payload_mass", "did you mean 'payload.mass'?"),  # and not how it is drawn
        ("cable_length", "did you mean 'cable.length'?"),
    ],
)
def test_unknown_name_without_a_section_is_looked_for_everywhere(name, hint):
    expected = f"unknown key '{name}' (unexpected keyword argument '{name}'); {hint}"
    assert refusal(ml.make_vec, "hover", **{name: 1}) == expected


def test_unknown_name_like_no_other_lists_sections_and_arguments():
    message = refusal(ml.make_vec, "hover", zzzzz=1)
    assert "known: cable, contact, control, env, " in message and message.startswith("unknown key 'zzzzz' (unexpected")
    assert "num_drones" in message


def test_two_values_of_one_key_are_refused_and_the_same_twice_is_not():
    message = refusal(ml.make_vec, "hover", num_drones=6, **{"env.num_drones": 4})
    assert message == "num_drones=6 and env.num_drones=4 were both given; leave out one of them"
    assert ml.make_vec("hover", num_envs=1, num_drones=3, **{"env.num_drones": 3}).num_drones == 3


def test_turbulence_needs_a_horizontal_mean_wind():
    windless = {"wind__turbulence": True, "wind__velocity": [0.0, 0.0, 2.0]}
    assert "set wind.turbulence_speed, wind.velocity or randomization.wind" in refuse_system(**windless)
    ml.load_config("hover", {"wind.turbulence": True, "randomization.wind": 2.0}).system  # noqa: B018 (not refused)


def test_unknown_key_like_no_other_lists_the_known_ones():
    assert re.match(r"unknown key 'sim\.zzz'.*control_hz, timestep", refuse_values(sim__zzz=1))


def test_unknown_key_in_a_file_names_the_file(write):
    message = refusal(load_config, write("env:\n  num_dronez: 3\n"))
    assert re.match(r"unknown key 'env\.num_dronez' .*mine\.yaml.*did you mean 'env\.num_drones'\?", message)


def test_unknown_configuration_names_the_nearest():
    assert refusal(load_config, "hovr") == "no configuration named 'hovr'; did you mean 'hover'?"


def test_unknown_task_names_the_nearest():
    config = load_config("hover", {"task": "hoover"})
    assert refusal(ml.make_vec, config) == "unknown task 'hoover'; did you mean 'hover'?"


def test_unknown_vehicle_names_the_nearest():
    message = refuse_system(vehicle__preset="falkon")
    assert message == "unknown vehicle.preset 'falkon'; did you mean 'falcon'?"


def test_unknown_reward_term_names_the_nearest():
    message = refuse_task(reward__postion=1.0)
    assert re.match(r"unknown key 'reward\.postion' of task hover; did you mean 'reward\.position'\?", message)


def test_unknown_task_option_names_the_nearest():
    message = refuse_task(task_options__target_xx=1.0)
    assert re.match(r"unknown key 'task_options\.target_xx'; did you mean 'task_options\.target_xy'\?", message)


def test_a_key_below_a_value_is_refused():
    assert re.search("task.*is a value, not a section", refuse_values(task__name="hover"))


# Types and ranges


@pytest.mark.parametrize(
    "key, value, complaint",
    [
        ("env.num_drones", "four", "must be a whole number"),
        ("env.num_drones", 2.5, "must be a whole number"),
        ("env.num_drones", "2.5", "must be a whole number"),
        ("env.num_drones", True, "must be a whole number"),
        ("env.num_drones", math.nan, "must be a whole number"),
        ("env.num_drones", 0, "must be greater than or equal to 1"),
        ("env.num_drones", 65, "must be less than or equal to 64"),
        ("env.num_envs", [4], "must be a"),
        ("seed", -1, "must be greater than or equal to 0"),
        ("train.asinh", -20, "must be 0, for no fine scale, or 0.001 to 1e6"),
        ("train.asinh", 1e-300, "must be 0, for no fine scale, or 0.001 to 1e6"),
        ("payload.mass", "heavy", "must be a number"),
        ("payload.mass", True, "must be a number"),
        ("payload.mass", -1.4, "must be greater than 0"),
        ("payload.mass", 0, "must be greater than 0"),
        ("payload.mass", math.nan, "must be a finite number"),
        ("payload.mass", "nan", "must be a finite number"),
        ("payload.mass", math.inf, "must be a finite number"),
        ("payload.shape", "sphere", "must be 'box', 'cylinder', 'mesh' or 'point'"),
        ("payload.inertia", [1.0, math.nan, 1.0], "must be a finite number"),
        ("payload.size", [0.5, -0.4, 0.1], "must be greater than 0"),
        ("cable.length", -1.0, "must be greater than 0"),
        ("cable.angle", 80, "must be less than 80"),
        ("sim.timestep", 0.1, "must be less than or equal to 0.02"),
        ("randomization.payload_mass", 1.0, "must be less than 1"),
        ("task", 3, "must be a"),
        ("task_options", 3, "must be a"),
    ],
)
def test_wrong_values_are_named_and_quoted(key, value, complaint):
    message = refuse_values(**{key: value})
    assert re.match(rf"{re.escape(key)} {complaint}.*, but is ", message), message


@pytest.mark.parametrize(
    "key, value, complaint",
    [
        ("payload.mass", 1e-6, "must be from 0.0001 to 1e+07 kg"),
        ("vehicle.mass", 1e-9, "must be from 0.0001 to 1e+07 kg"),
        ("vehicle.arm", 1e-9, "must be from 0.01 to 10 m"),
        ("vehicle.inertia", [1e-12, 1e-12, 1e-12], "must be from 1e-09 to 1e+07 kg m²"),
        ("cable.density", [1.0, 1.0, 1.0, 1e-12], "must be from 1e-09 to 100 kg/m"),
        ("sim.timestep", 1e-9, "must be greater than or equal to 0.00001"),
        ("wind.velocity", [1e39, 0.0, 0.0], "must be from -60 to 60 m/s"),
        ("randomization.payload_force", 1e300, "must be from 0 to 1e+06 N"),
        ("control.max_yaw", 1e18, "must be from 0 to 3.14159 rad"),
        ("control.max_velocity", 1e4, "must be from 0 to 50 m/s"),
        ("control.max_acceleration", 1e4, "must be from 0 to 1000 m/s²"),
        ("control.max_tilt_rate", 1e4, "must be from 0 to 100 rad/s"),
        ("control.max_offset", 1e4, "must be from 0 to 100 m"),
        ("reward.position.weight", 1e300, "must be from -1e+06 to 1e+06"),
    ],
)
def test_numbers_that_no_flight_can_have_are_named_with_their_bounds_and_unit(key, value, complaint):
    message = refuse_values(**{key: value})
    assert message.startswith(f"{key} {complaint}, but is "), message


@pytest.mark.parametrize(
    "overrides, culprit, cure",
    [
        ({"vehicle.mass": 0.005}, "vehicle.rotor_thrust_max", "raise the mass"),
        ({"vehicle.drag": [200.0, 0.0, 0.0]}, "vehicle.drag", "lower the drag"),
        ({"vehicle.inertia": [1e-6, 1e-6, 1e-6]}, "vehicle.inertia", "raise vehicle.inertia"),
        ({"vehicle.thrust_coefficient": 1e-12}, "vehicle.rotor_inertia", "raise vehicle.thrust_coefficient"),
        ({"vehicle.rotor_inertia": 2e-4, "sim.timestep": 1e-3}, "faster than 200 rad/s", "lower vehicle.rotor_inertia"),
        ({"wind.roll_moment": 50.0}, "wind.roll_moment", "lower them"),
        ({"wind.velocity": [40.0, 0, 0], "wind.gust": [40.0, 0, 0]}, "wind.gust", "lower them"),
        ({"randomization.payload_force": 5e3}, "randomization.payload_force", "lower it or raise payload.mass"),
        ({"payload.mass": 4e-4, "randomization.payload_force": 0.0}, "payload.drag_area", "raise payload.mass"),
        ({"payload.inertia": [1e-6] * 3}, "payload", "raise payload.inertia"),
        ({"payload.inertia": [1e-6] * 3, "sim.timestep": 1e-5}, "faster than 100 rad/s", "raise payload.inertia"),
        ({"cable.stiffness": 10.0}, "cable.stiffness", "raise cable.stiffness"),
        ({"cable.length": 0.01}, "cable.length", "raise cable.length"),
        ({"cable.length": 1.0, "randomization.cable_length": 0.99}, "randomization.cable_length", "lower"),
        ({"cable.model": "chain", "cable.density": 1e-9}, "cable.density", "lower cable.segments"),
        (
            {"control.attitude_frequency": None, "sim.control_hz": 25, "env.policy_hz": 25},
            "control.attitude_frequency=21.2121 rad/s",
            "raise sim.control_hz",
        ),
        ({"control.attitude_damping": 7.0}, "control.attitude_frequency=20 rad/s", "raise sim.control_hz"),
    ],
)
def test_what_the_time_step_cannot_follow_is_refused(overrides, culprit, cure):
    message = refuse_system(4, **overrides)
    assert culprit in message and cure in message, message


@pytest.mark.parametrize("value", ["much", True, math.nan])
def test_wrong_weight_names_its_reward_term(value):
    assert "reward.position.weight must be a" in refuse_values(reward__position=value)


@pytest.mark.parametrize(
    "value, complaint", [(-1, "must be greater than 0"), ("a", "must be a number"), (True, "must be a number")]
)
def test_wrong_value_in_a_list_for_the_drones_is_what_the_message_is_about(value, complaint):
    message = refuse_values(cable__length=[1.0, 1.0, 1.0, value])
    assert message.startswith("cable.length") and complaint in message, message


@pytest.mark.parametrize(
    "key, value",
    [
        ("wind.velocity", [1.0, 2.0]),
        ("wind.velocity", [1.0, 2.0, 3.0, 4.0]),
        ("payload.size", [0.5, 0.5]),
        ("payload.anchors", [[0.1, 0.1]] * 4),
        ("payload.anchors", [[0.1, 0.1, 0.1, 0.1]] * 4),
    ],
)
def test_vector_of_wrong_length_says_how_many_numbers_are_expected(key, value):
    message = refuse_values(**{key: value})
    assert message.startswith(key) and re.search(r"\b(3|three)\b", message), message


@pytest.mark.parametrize(
    "option, value, complaint",
    [
        ("target_xy", -1, "must be greater than or equal to 0"),
        ("target_xy", "far", "must be a number"),
        ("target_xy", True, "must be a number"),
        ("target_yaw", 181, "must be less than or equal to 180"),
        ("start_tilt", math.nan, "must be a finite number"),
        ("start_speed", 1e18, "must be within ± 60 m/s, but is 1e+18"),
        ("target_xy", 1e18, "must be within ± 10000 m, but is 1e+18"),
        ("target_height", [1.0, 1e18], "must be within ± 10000 m, but is [1.0, 1e+18]"),
        ("start_radius", 1e300, "must be within ± 10000 m"),
        ("success_seconds", 1e18, "must be within ± 1e+06 s"),
    ],
)
def test_wrong_task_option_is_named_in_plain_words(option, value, complaint):
    message = refuse_task(**{f"task_options.{option}": value})
    assert f"task_options.{option}" in message and complaint in message, message


@pytest.mark.parametrize("key", ["cable.length", "cable.stiffness", "cable.damping"])
@pytest.mark.parametrize("count", [1, 3, 5])
def test_list_of_wrong_length_names_both_numbers(key, count):
    message = refuse_system(**{key: [1e3] * count})
    assert re.match(rf"{key} lists {count} values for env\.num_drones=4: give", message)


@pytest.mark.parametrize("count", [0, 3, 5])
def test_anchors_must_be_as_many_as_drones(count):
    message = refuse_system(payload__anchors=[[0.1, 0.1, 0.1]] * count)
    assert re.match(rf"payload\.anchors lists {count} anchors for env\.num_drones=4: give", message)


# Files and command lines


@pytest.mark.parametrize("text", ["env: [1", "a: b: c", "env:\n\tnum_drones: 3"])
def test_broken_yaml_names_the_file_and_the_line(write, text):
    assert re.match(r"cannot read .*mine\.yaml as YAML: .*line \d+", refusal(load_config, write(text)))


@pytest.mark.parametrize("text, found", [("- 1\n- 2", "list"), ("3", "int"), ("hover", "str")])
def test_a_file_without_sections_is_refused(write, text, found):
    message = refusal(load_config, write(text))
    assert re.search(rf"mine\.yaml holds {found} where sections such as 'env:' are expected", message)


def test_an_empty_section_is_named(write):
    assert re.match(r"env\b.*mine\.yaml", refusal(load_config, write("env:\nseed: 3\n")))


def test_a_key_that_is_no_word_is_named(write):
    message = refusal(load_config, write("12: 3\n"))
    assert "mine.yaml" in message and re.search(r"\b12\b", message)


def test_missing_file_is_named(tmp_path):
    message = refusal(load_config, tmp_path / "none.yaml")
    assert re.match(r"no configuration file .*none\.yaml: give the path", message)


@pytest.mark.parametrize("argument", ["seed", "=3"])
def test_argument_without_key_or_value_is_refused(argument):
    assert f"'{argument}' is not of the form key=value" in refusal(parse_overrides, [argument])


def test_argument_that_is_no_yaml_is_refused():
    assert re.match(r"the value of seed=\[1 is not valid YAML", refusal(parse_overrides, ["seed=[1"]))


# Hostile files and command lines

BOMB = ", ".join(f"&a{i} [{', '.join([f'*a{i - 1}' if i else '1'] * 10)}]" for i in range(9))
HOSTILE = {
    "2020-01-01": "must be a number, but is '2020-01-01'",
    "0x_": "must be a number, but is '0x_'",
    "1:30": "must be a number, but is '1:30'",
    "!!python/object/apply:os.getcwd []": "is not taken",
    "!!int x": "the tag tag:yaml.org,2002:int is not taken",
    "&a [*a]": r"\*a holds itself",
    "&a {b: *a}": r"\*a holds itself",
    "[" * 3000 + "]" * 3000: "nested more than 30 deep",
    f"[{BOMB}]": "more than 20000 values",
    "{a: 1, a: 2}": "'a' is given twice",
    "1" * 5000: "too many digits",
    "\0": "special characters are not allowed",
    "=": "must be a number, but is '='",
    "x" * 5000: "must be a number, but is 'xxx",
}


@pytest.mark.parametrize("text", HOSTILE, ids=lambda text: repr(text[:12]))
def test_hostile_values_are_refused_in_a_short_sentence(write, text):
    from_line = refusal(lambda: load_config("hover", parse_overrides([f"payload.mass={text}"])))
    from_file = refusal(load_config, write(f"payload:\n  mass: {text}\n"))
    for message in (from_line, from_file):
        assert re.search(HOSTILE[text], message) and len(message) < 500, message


@pytest.mark.parametrize("text, value", [("0o17", 15), ("017", 17), ("0x1F", 31), ("1_000", 1000), ("2e3", 2000)])
def test_whole_numbers_are_those_of_yaml_1_2(write, text, value):
    assert load_config("hover", parse_overrides([f"seed={text}"])).seed == value
    assert load_config(write(f"seed: {text}")).seed == value


@pytest.mark.parametrize("name", ["2e6", "0o17", "017", "1:30", "2020-01-01", "yes", "=", "a b: c"])
def test_text_that_looks_like_a_number_survives_a_dump(write, name):
    config = load_config("hover", {"task_options.anything": name})
    assert load_config(write(dump_config(config))) == config


def test_a_key_given_twice_is_refused(write):
    assert refusal(parse_overrides, ["seed=1", "seed=2"]) == "seed is given twice; leave out one of them"
    assert "'seed' is given twice (line 3)" in refusal(load_config, write("seed: 1\nenv: {}\nseed: 2\n"))


def test_aliases_and_merges_are_taken(write):
    config = load_config(write("randomization: &r {payload_mass: 0.1}\ntrain: {overrides: {<<: *r}}\n"))
    assert config.train.overrides == {"payload_mass": 0.1}


@pytest.mark.parametrize(
    "key, value",
    [
        ("env.num_envs", "1e8"), ("train.horizon", "1e12"), ("train.hidden", "[]"), ("train.hidden", "[1e9]"),
        ("train.threads", "1e9"), ("env.episode_seconds", "1e308"), ("seed", "1e400"), ("seed", "1e300"),
    ],
)  # fmt: skip
def test_sizes_that_no_machine_has_are_refused_before_anything_is_built(key, value):
    assert refuse_values(**parse_overrides([f"{key}={value}"])).startswith(f"{key} must")


def test_what_is_no_file_is_refused_and_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "pipe.yaml")
    (tmp_path / "folder.yaml").mkdir()
    os.symlink("/dev/zero", tmp_path / "device.yaml")
    (tmp_path / "long.yaml").write_text("#" * 2_000_000)
    (tmp_path / "bytes.yaml").write_bytes(b"seed: \xff")
    for name, words in (
        ("pipe", "no regular file"), ("folder", "no regular file"), ("device", "no regular file"),
        ("long", "longer than 1000000 bytes"), ("bytes", "can't decode"), ("a\0b", "null byte"),
        ("x" * 300, "too long"),
    ):  # fmt: skip
        assert words in refusal(load_config, tmp_path / f"{name}.yaml")
    for name in ("\0", "x" * 5000):
        assert re.match("cannot read|no configuration named", refusal(load_config, name))
        assert "file that can be read" in refuse_values(task_options__file=name)


def test_damaged_configurations_load_or_are_refused(write):
    """A small fuzzer: whatever a file holds, nothing but a ConfigError comes of it."""
    rng, whole = random.Random(0), (config_dir() / "hover.yaml").read_bytes()
    for _ in range(60):
        text = bytearray(whole[: rng.randrange(len(whole))])
        for _ in range(rng.choice([0, 1, 5]) if text else 0):
            text[rng.randrange(len(text))] = rng.randrange(256)
        path = write("")
        path.write_bytes(text)
        try:
            load_config(path)
        except ConfigError as error:
            assert "\n" not in str(error)
