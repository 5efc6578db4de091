"""Configurations: what wins over what, what is refused, and how it is said."""

from __future__ import annotations

import math
import re

import numpy as np
import pytest
import yaml
from conftest import GRAVITY, TASKS, make_system

import multilift_marl as ml
from multilift_marl.config import Config, build_config, dump_config, explain, list_configs, load_config, parse_overrides
from multilift_marl.config.schema import Section
from multilift_marl.config.system import MIN_THRUST_TO_WEIGHT, formation_forces
from multilift_marl.config.vehicles import PRESETS
from multilift_marl.errors import ConfigError

JARGON = ("Input ", "Value error", "Field required", "Tuple ", "instance of", "\n", ". ", "  ", "Errno")


def refusal(build, *arguments, **keywords) -> str:
    """Return the message of the ConfigError, checked to be one sentence in plain words."""
    with pytest.raises(ConfigError) as caught:
        build(*arguments, **keywords)
    message = str(caught.value)
    assert message == message.strip()
    assert not [word for word in JARGON if word in message], message
    return message


def refuse_values(**overrides) -> str:
    return refusal(load_config, "hover", {key.replace("__", "."): value for key, value in overrides.items()})


def refuse_system(num_drones: int = 4, **overrides) -> str:
    return refusal(make_system, num_drones, **{key.replace("__", "."): value for key, value in overrides.items()})


def refuse_task(**overrides) -> str:
    overrides = {key.replace("__", "."): value for key, value in overrides.items()}
    return refusal(ml.make_vec, "hover", num_envs=1, num_threads=1, **overrides)


@pytest.fixture
def write(tmp_path):
    """Return a writer of YAML files."""

    def write(text: str, name: str = "mine.yaml"):
        path = tmp_path / name
        path.write_text(text, encoding="utf-8")
        return path

    return write


# What wins over what


def test_defaults_lose_to_the_file_and_the_file_to_overrides(write):
    path = write("seed: 7\nenv:\n  num_drones: 3\n  num_envs: 5\n")
    config = load_config(path, {"env.num_envs": 9})
    assert (config.env.num_envs, config.env.num_drones, config.seed) == (9, 3, 7)
    assert config.sim.timestep == Config().sim.timestep


def test_an_override_leaves_its_neighbours_in_the_file_alone(write):
    config = load_config(
        write("randomization: {payload_mass: 0.1, payload_force: 1.0}"), {"randomization.payload_mass": 0}
    )
    assert (config.randomization.payload_mass, config.randomization.payload_force) == (0.0, 1.0)


def test_a_section_as_an_override_leaves_its_neighbours_in_the_file_alone():
    config = load_config("hover", {"randomization": {"payload_mass": 0.1}})
    assert (config.randomization.payload_mass, config.randomization.payload_force) == (0.1, 1.5)


def test_overriding_one_configuration_does_not_change_the_next():
    nested = {"env": {"num_envs": 5}}
    assert build_config(nested, {"env.num_envs": 9, "env.num_drones": 2}).env.num_envs == 9
    assert nested == {"env": {"num_envs": 5}}
    assert build_config(nested).env.num_envs == 5


def test_an_empty_file_is_the_defaults(write):
    assert load_config(write("")) == Config()


def test_a_configuration_cannot_be_changed_after_it_was_checked():
    with pytest.raises(ValueError, match="frozen"):
        load_config("hover").env.num_drones = 3


@pytest.mark.parametrize("name", list_configs())
def test_every_shipped_configuration_names_a_task_and_a_possible_system(name):
    config = load_config(name)
    assert config.task in TASKS
    assert config.system.num_drones == config.env.num_drones


@pytest.mark.parametrize(
    "text, key, value",
    [
        ("2e6", "train.frames", 2_000_000),
        ("1e3", "env.num_envs", 1000),
        ("3.0", "env.num_drones", 3),
        ("1e-3", "train.learning_rate", 1e-3),
        ("2e-3", "sim.timestep", 2e-3),
        ("[1e5, 2e5, 1e5, 2e5]", "cable.stiffness", (1e5, 2e5, 1e5, 2e5)),
        ("false", "task_options.anything", False),
    ],
)
def test_numbers_as_people_write_them(text, key, value):
    config = load_config("hover", parse_overrides([f"{key}={text}"]))
    section, name = key.split(".")
    found = config.task_options[name] if section == "task_options" else getattr(getattr(config, section), name)
    assert found == value
    assert type(found) is type(value)


def test_exponents_in_a_file(write):
    config = load_config(write("train:\n  frames: 2e6\n  learning_rate: 1e-3\n"))
    assert (config.train.frames, config.train.learning_rate) == (2_000_000, 1e-3)


@pytest.mark.parametrize(
    "overrides",
    [
        {},
        {"cable.length": [1.0, 1.1, 1.2, 1.3], "wind.velocity": [1, 0, 0], "reward.position": 2},
        {"payload.shape": "point", "payload.mass": 0.1 + 0.2, "task_options.target_xy": 0.5, "train.hidden": [32]},
    ],
    ids=["plain", "lists", "point"],
)
def test_a_resolved_dump_loads_back_equal(write, overrides):
    config = load_config("hover", overrides)
    assert load_config(write(dump_config(config))) == config


def leaves(section: type[Section], prefix: str = ""):
    for name, field in section.model_fields.items():
        if isinstance(field.annotation, type) and issubclass(field.annotation, Section):
            yield from leaves(field.annotation, f"{prefix}{name}.")
        else:
            yield prefix + name, field.description


@pytest.mark.parametrize("key, description", list(leaves(Config)))
def test_explain_lists_every_key_with_its_description(key, description):
    assert description
    assert re.search(rf"^  {re.escape(key)}[ .].* {re.escape(description)}$", explain(), re.MULTILINE)


def test_a_dump_holds_every_key_that_explain_lists():
    resolved = yaml.safe_load(dump_config(Config()))
    for key, _ in leaves(Config):
        node = resolved
        for part in key.split("."):
            node = node[part]


# What is refused: names


@pytest.mark.parametrize(
    "key, nearest",
    [
        ("sed", "seed"),
        ("randomisation", "randomization"),
        ("env.num_dronez", "num_drones"),
        ("sim.time_step", "timestep"),
        ("payload.mas", "mass"),
        ("cable.stifness", "stiffness"),
        ("train.learningrate", "learning_rate"),
        ("eval.episode", "episodes"),
    ],
)
def test_unknown_key_names_the_nearest(key, nearest):
    message = refuse_values(**{key: 1})
    assert re.fullmatch(rf"unknown key '{re.escape(key)}'.*did you mean '{nearest}'\?", message)


def test_unknown_key_like_no_other_lists_the_known_ones():
    assert re.match(r"unknown key 'sim\.zzz'.*control_hz, timestep", refuse_values(sim__zzz=1))


def test_unknown_key_in_a_file_names_the_file(write):
    message = refusal(load_config, write("env:\n  num_dronez: 3\n"))
    assert re.match(r"unknown key 'env\.num_dronez' .*mine\.yaml.*did you mean 'num_drones'\?", message)


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
    assert re.match(r"unknown key 'reward\.postion' of task hover; did you mean 'position'\?", message)


def test_unknown_task_option_names_the_nearest():
    message = refuse_task(task_options__target_xx=1.0)
    assert re.match(r"unknown key 'task_options\.target_xx'; did you mean 'target_xy'\?", message)


def test_a_key_below_a_value_is_refused():
    assert re.search("task.*is a value, not a section", refuse_values(task__name="hover"))


# What is refused: types and ranges


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
        ("payload.mass", "heavy", "must be a number"),
        ("payload.mass", True, "must be a number"),
        ("payload.mass", -1.4, "must be greater than 0"),
        ("payload.mass", 0, "must be greater than 0"),
        ("payload.mass", math.nan, "must be a finite number"),
        ("payload.mass", "nan", "must be a finite number"),
        ("payload.mass", math.inf, "must be a finite number"),
        ("payload.shape", "sphere", "must be 'box' or 'point'"),
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


@pytest.mark.parametrize("value", ["much", True, math.nan])
def test_wrong_weight_names_its_reward_term(value):
    assert "reward.position must be a" in refuse_values(reward__position=value)


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


# What is refused: files and command lines


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


# What is refused: systems that cannot be

PLANE = [[0.25, 0.2, 0.08], [-0.25, 0.2, 0.08], [-0.25, -0.2, 0.08], [0.25, -0.2, 0.08]]


def test_anchors_out_of_reach():
    message = refuse_system(payload__anchors=[[5.0, 5.0, 0.08], *PLANE[1:]])
    assert re.match(r"payload\.anchors: anchor 0 is out of reach, 6\.\d\d m outside .*; move it", message)


def test_anchors_in_one_place_beside_the_centre_cannot_hold_level():
    message = refuse_system(payload__anchors=[[0.25, 0.2, 0.08]] * 4)
    assert re.match(r"payload\.anchors .* cannot hold the payload level: place them around", message)


def test_anchors_on_one_side_would_need_a_cable_that_pushes():
    message = refuse_system(
        payload__anchors=[[0.25, 0.2, 0.08], [0.3, -0.2, 0.08], [0.28, 0.0, 0.08], [0.02, 0.0, 0.08]]
    )
    assert re.match(r"payload\.anchors: cable \d would have to push; move", message)


@pytest.mark.parametrize(
    "overrides",
    [
        {"cable.angle": 0, "payload.anchors": [[x / 5, y / 5, z] for x, y, z in PLANE]},
        {"payload.shape": "point", "cable.length": 0.3},
    ],
    ids=["parallel cables", "short cables"],
)
def test_neighbours_too_close_at_rest(overrides):
    message = refuse_system(**overrides)
    assert re.match(
        r"neighbouring drones would rest 0\.\d\d m apart, closer than .*0\.35 m; spread payload\.anchors", message
    )


def heaviest(num_drones: int) -> float:
    """Return the payload mass at which the team's thrust is 1.18 times the weight of drones and payload."""
    vehicle = PRESETS["falcon"]
    lift = num_drones * 4 * vehicle.rotor_thrust_max
    return lift / (MIN_THRUST_TO_WEIGHT * GRAVITY) - num_drones * vehicle.mass


@pytest.mark.parametrize("count", [1, 4, 6])
def test_team_thrust_below_1_18_times_the_weight_is_refused(count):
    assert MIN_THRUST_TO_WEIGHT == 1.18
    make_system(count, **{"payload.mass": 0.999 * heaviest(count), "cable.angle": 10})
    message = refuse_system(count, payload__mass=1.001 * heaviest(count), cable__angle=10)
    assert re.match(rf"{count} × falcon lift {count * 20}\.0 N, less than 1\.18 × .*; lower payload\.mass", message)


def test_a_drone_that_could_not_hover_is_refused():
    assert re.match(
        r"drone \d would need .* to hover; lower payload\.mass, cable\.angle", refuse_system(cable__angle=79)
    )


def test_inertia_against_the_triangle_inequality():
    message = refuse_system(payload__inertia=[0.01, 0.01, 0.03])
    assert re.match(r"payload\.inertia \[0\.01, 0\.01, 0\.03\] is impossible: no moment may exceed the sum", message)


def test_a_flat_body_has_the_largest_possible_inertia():
    assert make_system(4, **{"payload.inertia": [0.01, 0.01, 0.02]}).payload_inertia.tolist() == [0.01, 0.01, 0.02]


def test_point_payload_has_no_place_for_anchors():
    message = refuse_system(payload__shape="point", payload__anchors=PLANE)
    assert re.match(r"payload\.anchors of a point payload must all be \[0, 0, 0\]; use payload\.shape=box", message)


@pytest.mark.parametrize("overrides", [{"sim.control_hz": 300}, {"sim.control_hz": 200}, {"sim.timestep": 0.003}])
def test_control_rate_that_is_no_whole_number_of_physics_steps(overrides):
    assert re.match(
        r"sim\.control_hz=\d+ must divide 1/sim\.timestep=[\d.]+ into whole steps", refuse_system(**overrides)
    )


@pytest.mark.parametrize("rate", [60, 300])
def test_policy_rate_that_is_no_whole_number_of_control_steps(rate):
    message = refuse_task(env__policy_hz=rate)
    assert re.match(rf"env\.policy_hz={rate} must divide sim\.control_hz=250 into whole steps", message)


def test_episode_shorter_than_a_step():
    assert re.match(
        r"env\.episode_seconds=0\.001 is shorter than one step; raise it", refuse_task(env__episode_seconds=1e-3)
    )


def test_start_that_always_fails_names_the_failure_and_the_cure():
    vec = ml.make_vec(
        "hover",
        num_envs=1,
        num_threads=1,
        **{"task_options.target_height": [0.01, 0.02], "task_options.start_radius": 0},
    )
    message = refusal(vec.reset)
    assert re.match(
        r"no start of task hover is free of failure \(ground\).*; narrow the start ranges in task_options", message
    )


# The standard rig


@pytest.mark.parametrize("shape", ["box", "point"])
@pytest.mark.parametrize("num_drones", [1, 2, 3, 4, 5, 6, 16, 64])
def test_standard_rig_scales_with_the_team(num_drones, shape):
    system = make_system(num_drones, **{"payload.shape": shape})
    assert system.payload_mass == pytest.approx(0.35 * num_drones)
    apart = np.linalg.norm(system.slots[:, None] - system.slots[None], axis=-1)[~np.eye(num_drones, dtype=bool)]
    assert (apart >= 0.6 - 1e-6).all()


@pytest.mark.parametrize("num_drones", [2, 3, 4, 6])
def test_cables_of_the_standard_rig_stand_at_their_angle(num_drones):
    force = make_system(num_drones, **{"cable.angle": 25}).formation_force
    np.testing.assert_allclose(np.hypot(force[:, 0], force[:, 1]) / force[:, 2], np.tan(np.deg2rad(25)), rtol=1e-9)


def test_box_inertia_is_that_of_a_uniform_box():
    system = make_system(4, **{"payload.mass": 1.2, "payload.size": [0.6, 0.4, 0.2]})
    np.testing.assert_allclose(system.payload_inertia, [0.1 * (0.16 + 0.04), 0.1 * (0.36 + 0.04), 0.1 * (0.36 + 0.16)])


@pytest.mark.parametrize("seed", range(4))
def test_formation_forces_balance_weight_and_moments_of_any_anchors(seed):
    rng = np.random.default_rng(seed)
    around = np.linspace(0, 2 * np.pi, 5, endpoint=False) + rng.uniform(-0.2, 0.2, 5)
    anchors = np.stack([0.4 * np.cos(around), 0.3 * np.sin(around), rng.uniform(-0.1, 0.1, 5)], axis=1)
    force = formation_forces(anchors, 20.0, np.deg2rad(30), point=False)
    np.testing.assert_allclose(force.sum(axis=0), [0, 0, 20], atol=1e-9)
    np.testing.assert_allclose(np.cross(anchors, force).sum(axis=0), 0, atol=1e-9)
