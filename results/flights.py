"""The flights on which policies are evaluated: rows of the tables, and the recipe whose policies are used."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

from multilift_marl.config.load import load_config
from multilift_marl.tasks import find_task

HERE = Path(__file__).parent
ROOT = Path(__file__).parents[1]
EPISODES = 1000
SEED = 1000
FASTER = {"task_options.speed": 2.0, "task_options.acceleration": 2.0}
AGILE = {"task_options.speed": 2.0, "task_options.acceleration": 4.0}
FASTEST = {"task_options.speed": 5.0, "task_options.acceleration": 8.0}
UNSEEN_RIG = {"env.num_drones": 5, "vehicle.preset": "falcon", "cable.length": 0.6, "payload.mass": 2.16}
"""A held-out rig of docs/learning.md."""

ESTIMATED = "payload not measured"  # the largest difference from the published figures; docs/track.md, docs/recover.md
AUTO = "41 cm: path of 2.8 m/s², start included; MPC, no motor lag, no drag"
CRAZYMARL = "79.7 %: motor commands, no motor lag"


FOLLOWING = ("formation_feedback", "searched")


class Flight(NamedTuple):
    """A row of the table."""

    config: str
    overrides: dict[str, Any]
    recipe: str
    """Whose policies are evaluated."""
    title: str
    published: str = ""
    scripts: tuple[str, ...] = ()
    """Baselines that are evaluated; none: all that fit."""


FLIGHTS: dict[str, Flight] = {
    "hover": Flight("hover", {}, "hover", "hover"),
    "hover_acc_rates": Flight(
        "hover_acc_rates", {}, "hover_acc_rates", "hover, acceleration and tilt-rate actions, no base policy"
    ),
    "hover_ctbr": Flight("hover_ctbr", {}, "hover_ctbr", "hover, thrust and body-rate actions, no base policy"),
    "hover_ctbm": Flight("hover_ctbm", {}, "hover_ctbm", "hover, thrust and moment actions, no base policy"),
    "hover_rotor": Flight("hover_rotor", {}, "hover_rotor", "hover, rotor-thrust actions, no base policy"),
    "hover_wind": Flight("hover_wind", {}, "hover_wind", "hover, 5 m/s wind, noise, delay"),
    "hover_realistic": Flight("hover_realistic", {}, "hover_realistic", "hover, realistic"),
    "pose_easy": Flight("pose_easy", {}, "pose", "pose, tilts to 20°"),
    "pose": Flight("pose", {}, "pose", "pose, tilts to 45°"),
    "pose_falcon3": Flight("pose_falcon3", {}, "pose_falcon3", "pose, three drones, tilts to 45°"),
    "pose_wind": Flight("pose_wind", {}, "pose_wind", "pose, tilts to 45°, 5 m/s wind, noise, delay"),
    "pose_tudelft": Flight(
        "pose_tudelft",
        {},
        "pose_tudelft",
        "pose, tilts to 45°, no planned trajectory (TU Delft's protocol)",
        scripts=("searched",),
    ),
    "circle_slow": Flight("track_circle", {}, "track_circle", "circle, 0.2 rad/s"),
    "circle_fast": Flight("track_circle", {"task_options.rate": 0.4}, "track_circle", "circle, 0.4 rad/s"),
    "track": Flight("track", {}, "track", "figure-eight, 1 m/s, 0.5 m/s²", f"3.2 cm: geometric control, {ESTIMATED}"),
    "track_2_2": Flight("track", FASTER, "track", "figure-eight, 2 m/s, 2 m/s²", f"9.3 cm: 10 Hz planner, {ESTIMATED}"),
    "track_2_4": Flight("track", AGILE, "track", "figure-eight, 2 m/s, 4 m/s²", f"11.7 cm: 10 Hz planner, {ESTIMATED}"),
    "track_5_8": Flight(
        "track", FASTEST, "track", "figure-eight, 5 m/s, 8 m/s²", f"19.7 cm: 10 Hz planner, {ESTIMATED}"
    ),
    "track_rates_2_4": Flight(
        "track_rates",
        AGILE,
        "track_rates",
        "figure-eight, 2 m/s, 4 m/s², acceleration and tilt-rate actions",
        scripts=("searched",),
    ),
    "track_rates_5_8": Flight(
        "track_rates",
        FASTEST,
        "track_rates",
        "figure-eight, 5 m/s, 8 m/s², acceleration and tilt-rate actions",
        scripts=("searched",),
    ),
    "track_realistic_2_4": Flight(
        "track_realistic", {}, "track_realistic", "figure-eight, 2 m/s, 4 m/s², realistic", scripts=FOLLOWING
    ),
    "track_realistic_5_8": Flight(
        "track_realistic_fast",
        {},
        "track_realistic_fast",
        "figure-eight, 5 m/s, 8 m/s², realistic",
        scripts=FOLLOWING,
    ),
    "track_follow_2_2": Flight(
        "track_follow", FASTER, "track_follow", "figure-eight, 2 m/s, 2 m/s², no preview", scripts=FOLLOWING
    ),
    "track_follow_2_4": Flight(
        "track_follow", AGILE, "track_follow", "figure-eight, 2 m/s, 4 m/s², no preview", scripts=FOLLOWING
    ),
    "track_auto6": Flight("track_auto6", {}, "track_auto6", "figure-eight, 4.5 m/s, 4 m/s², six drones, 7 kg", AUTO),
    "track_generalist": Flight(
        "track_generalist",
        UNSEEN_RIG,
        "track_generalist",
        "figure-eight, 2 m/s, 2 m/s², one policy for twelve rigs, on a held-out rig",
        scripts=("formation_lead", "searched"),
    ),
    "takeoff": Flight("takeoff", {}, "takeoff", "takeoff"),
    "land": Flight("land", {}, "land", "land"),
    "gate": Flight("gate", {}, "gate", "gate"),
    "gate_realistic": Flight(
        "gate_realistic", {}, "gate_realistic", "gate, realistic", scripts=("formation_narrow", "searched")
    ),
    "gate_realistic_3": Flight(
        "gate_realistic",
        {"env.num_drones": 3},
        "gate_realistic",
        "gate, realistic, three drones",
        scripts=("searched",),
    ),
    "gate_realistic_5": Flight(
        "gate_realistic", {"env.num_drones": 5}, "gate_realistic", "gate, realistic, five drones", scripts=("searched",)
    ),
    "gate_two": Flight(
        "gate_two", {}, "gate_two", "gate, two walls, gaps of 0.8 to 1.2 m", scripts=("formation_narrow", "searched")
    ),
    "gate_three": Flight(
        "gate_three",
        {},
        "gate_three",
        "gate, three walls, gaps of 0.8 to 1.2 m",
        scripts=("formation_narrow", "searched"),
    ),
    "navigate_senses": Flight(
        "navigate_senses",
        {},
        "navigate_senses",
        "navigate, unknown obstacles, own late senses",
        scripts=("formation", "formation_repelled"),
    ),
    "navigate_senses_px4": Flight(
        "navigate_senses_px4",
        {},
        "navigate_senses_px4",
        "navigate, unknown obstacles, own late senses, loops of PX4",
        scripts=("formation", "formation_repelled"),
    ),
    "navigate_course": Flight(
        "navigate_course",
        {},
        "navigate_senses",
        "navigate, unknown obstacles over 20 m",
        scripts=("formation", "formation_repelled"),
    ),
    "navigate_slots": Flight(
        "navigate_slots",
        {},
        "navigate_slots",
        "navigate, a wall's gap of 0.5 to 1.1 formations, own late senses to 1.5 m",
        scripts=("formation", "formation_repelled", "formation_filed"),
    ),
    "regroup_senses": Flight(
        "regroup_senses",
        {},
        "regroup_senses",
        "regroup, own senses",
        scripts=("formation", "formation_integral", "formation_adaptive"),
    ),
    "recover": Flight("recover", {}, "recover", "recover"),
    "recover_realistic": Flight("recover_realistic", {}, "recover_realistic", "recover, realistic", scripts=FOLLOWING),
    "recover_crazymarl": Flight("recover_crazymarl", {}, "recover_crazymarl", "recover, CrazyMARL's starts", CRAZYMARL),
    "recover_crazymarl_rates": Flight(
        "recover_crazymarl_rates",
        {},
        "recover_crazymarl_rates",
        "recover, CrazyMARL's starts, thrust and body-rate actions at 250 Hz",
        "79.7 %: motor commands, no noise, no motor lag",
        ("searched",),
    ),
    "loss": Flight("loss", {}, "loss", "loss, 4 drones"),
    "loss_realistic": Flight(
        "loss_realistic",
        {},
        "loss_realistic",
        "loss, realistic",
        scripts=("formation_redistributed", "searched"),
    ),
    "loss_onboard": Flight(
        "loss",
        {"env.sensing": "onboard"},
        "loss_onboard",
        "loss, onboard sensing, no communication",
        scripts=("formation_redistributed", "searched"),
    ),
    "loss_6": Flight("loss_6", {}, "loss_6", "loss, 6 drones"),
    "loss_snap": Flight("loss_snap", {}, "loss", "loss, 4 drones, cable breaks too"),
}


SCRIPTED = {"control.action": "reference"}
"""Actions of the baselines, whatever those of the learned policies that they are compared with."""
MPC = {
    "control.action": "full_state",
    "control.max_offset": 2.0,
    "control.max_velocity": 5.0,
    "control.max_acceleration": 25.0,
    "control.max_jerk": 300.0,
    "control.max_cable_force": 5.0,
    "control.disturbance": "none",
}
"""Actions of the central planner, which knows all states and the path ahead."""
OWN_PLANNERS: dict[str, dict[str, Any]] = {
    # where delays of up to two steps and hidden cables come with thrusts near their limits
    "track_realistic_5_8": {"planner.lead": 0.08, "planner.least_tension": 0.2, "planner.tension": 0.1},
}
"""Settings of the planner that differ from the defaults, by flight."""
PLANNED_EPISODES = 250
"""Of the central planner, which takes a millisecond a step of each."""


def episodes_of(team: str) -> int:
    """Return how many episodes a policy is evaluated on."""
    return PLANNED_EPISODES if team == "mpc" else EPISODES


def error_metric(flight: Flight) -> str:
    """Return the metric by which the teams of a flight are compared."""
    return find_task(load_config(flight.config).task).ERROR
