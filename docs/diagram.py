"""Draw the pipeline of docs/pipeline.md: processes, and the topics between them.

Run: python docs/diagram.py      (writes docs/images/pipeline.png)
"""

from __future__ import annotations

from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt

BOXES = {  # name: x, y of the centre, words; colour by who it is
    "planner": (1.9, 4.6, "trajectory or MPC planner\nrole=trajectory_planner, mpc_planner", "node"),
    "control": (6.4, 4.6, "geometric control\nrole=geometric_control", "node"),
    "clock": (10.3, 2.4, "clock\nrole=clock", "node"),
    "bridge": (6.4, 2.4, "flight: state machine, bridge,\nsimulation (MuJoCo)\nmultilift_marl.px4", "flight"),
    "px4": (6.4, 0.5, "PX4 autopilots, one per drone\nEKF2, attitude and rate loops", "px4"),
    "ground": (1.9, 2.4, "your node or ground station\nRViz, Foxglove, ros2 bag", "other"),
}
COLOURS = {"node": "#d6e6f5", "flight": "#fbe3c8", "px4": "#dcefd8", "other": "#eeeeee"}
ARROWS = [  # from, to, words, where they stand
    ((4.0, 4.6), (5.1, 4.6), "/drone_i/\ntrajectory_setpoint", (4.55, 5.02)),
    ((6.8, 4.1), (6.8, 3.1), "/fmu/in/vehicle_attitude_setpoint_v1\nor vehicle_rates_setpoint", (6.95, 3.75)),
    ((5.9, 3.1), (5.9, 4.1), "/fmu/out/\nvehicle_odometry", (5.8, 3.45)),
    ((5.0, 3.0), (2.6, 4.1), "/payload_odom, odometry,\n/state/state_drone_i", (2.7, 3.42)),
    ((8.2, 2.55), (9.5, 2.55), "/clock", (8.85, 2.75)),
    ((9.5, 2.25), (8.2, 2.25), "/sync_time\nto all", (8.85, 1.9)),
    ((3.5, 2.55), (4.65, 2.55), "/state/\ncommand_drone_i", (4.1, 2.92)),
    ((4.65, 2.25), (3.5, 2.25), "all topics", (4.1, 2.0)),
    ((6.05, 1.7), (6.05, 1.0), "HIL_SENSOR, HIL_GPS\nset-points (MAVLink)", (5.95, 1.35)),
    ((6.75, 1.0), (6.75, 1.7), "motor commands, estimates\nlockstep, 250 Hz", (6.85, 1.35)),
]
RIGHT = {"/fmu/out/\nvehicle_odometry", "HIL_SENSOR, HIL_GPS\nset-points (MAVLink)"}  # aligned to end at their place
LEFT = {"motor commands, estimates\nlockstep, 250 Hz"}


def main() -> None:
    """Draw."""
    figure, axes = plt.subplots(figsize=(9.6, 4.6), dpi=110)
    for x, y, words, kind in BOXES.values():
        style = {"boxstyle": "round,pad=0.5", "facecolor": COLOURS[kind], "edgecolor": "#444444"}
        axes.text(x, y, words, ha="center", va="center", fontsize=9.5, bbox=style)
    for begin, end, words, place in ARROWS:
        axes.annotate("", end, begin, arrowprops={"arrowstyle": "-|>", "color": "#444444", "lw": 1.3})
        side = "right" if words in RIGHT else "left" if words in LEFT or words.startswith("/fmu/in") else "center"
        axes.text(*place, words, ha=side, va="center", fontsize=8, color="#1f4e79", family="monospace")
    axes.set(xlim=(-0.2, 11.3), ylim=(0, 5.3))
    axes.axis("off")
    figure.tight_layout(pad=0.3)
    figure.savefig(Path(__file__).parent / "images" / "pipeline.png")


if __name__ == "__main__":
    main()
