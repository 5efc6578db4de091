"""Follow the figure-eight that Auto-Multilift's authors published, and compare with their team's result on it.

  python results/auto_multilift.py <folder> [episodes]     (16)

<folder> is "Source code A/Evaluation_Little_faster_Fig-8/Evaluation results(cl_3)" of a clone of the repository
RCL-NUS/Auto-Multilift (arXiv 2406.04858). It holds 20 s at 5 ms: Ref_Load (the load's reference, held for 20 ms),
Load_State and EULERl (the load's motion). The path is written to runs/auto_multilift/fig8.npy, for

  python evaluate.py run=track_auto6 task_options.path=file task_options.file=runs/auto_multilift/fig8.npy

Root mean square errors over all 20 s, start included, are printed and written to results/auto_multilift.json, a figure
to docs/images/auto_multilift.png.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from script import run_script

from multilift_marl.agents.policy import load_policy
from multilift_marl.config.config import Config
from multilift_marl.config.load import build_config, load_config
from multilift_marl.envs.core import MultiliftVec
from multilift_marl.errors import ConfigError
from multilift_marl.evaluation.plots import POLICY_COLOURS
from multilift_marl.evaluation.rollout import Trace, run_episodes, trace_episode
from multilift_marl.policies.baselines import fitting_scripts, make_scripted

HERE = Path(__file__).parent
ROOT = Path(__file__).parents[1]
HELD, SEED = 4, 1000  # steps of 5 ms that the reference is held; evaluation seed
NO_DRAG = {"payload.drag_area": 0.0}
AXES = ("x_m", "y_m", "z_m", "roll_deg", "pitch_deg", "yaw_deg")
DRAWN = ("formation_lead", "seed0")


def read_published(folder: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return time (T,) [s], reference and position of their load (T, 3) [m], its roll, pitch and yaw (T, 3) [deg]."""
    name = "{}_fig_8_6quad_cl.npy"
    reference = np.load(folder / name.format("Ref_Load"))[::HELD, :3, 0]
    position = np.load(folder / name.format("Load_State"))[::HELD, :3, 0]
    angles = np.rad2deg(np.load(folder / name.format("EULERl")).T[::HELD])
    return np.load(folder / "TIME.npy")[::HELD], reference, position, angles


def make_teams(config: Config) -> dict[str, Callable[[MultiliftVec], Any]]:
    """Return the makers of all teams: the scripts that fit, and the learned teams of the recipe track_auto6."""
    probe = MultiliftVec(build_config(config.model_dump(), {"env.num_envs": 1}))
    teams: dict[str, Callable[[MultiliftVec], Any]] = {
        script: (lambda vec, script=script: make_scripted(script, vec)) for script in fitting_scripts(probe)
    }
    for weights in sorted((HERE / "track_auto6").glob("seed*/policy.pt")):
        teams[weights.parent.name] = load_policy(weights).bind
    return teams


def fly(config: Config, episodes: int) -> dict[str, dict[str, float]]:
    """Return {team: {metric: mean}} over some episodes, and the largest distance of the first one [m]."""
    results = {}
    for team, make in make_teams(config).items():
        measured = run_episodes(config, make, episodes, SEED)
        means = {axis: float(measured[f"payload_rmse_{axis}"].mean()) for axis in AXES}
        largest = float(trace_episode(config, make, 0, SEED).distance.max())
        results[team] = means | {"distance_m": float(measured["payload_rmse_m"].mean()), "largest_m": largest}
    return results


def draw(path: Path, reference: np.ndarray, distances: dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]]) -> None:
    """Draw the paths from above and the distances from the target over time.

    Args:
        path: of the PNG.
        reference: (T, 3) [m].
        distances: {team: (time (T,) [s], position (T, 3) [m], distance (T,) [m])}.
    """
    figure = Figure(figsize=(9.6, 4.4), layout="constrained")
    above, error = figure.subplots(1, 2)
    above.plot(*reference[:, :2].T, color="0.6", linewidth=4, label="reference")
    for (team, (time, position, distance)), colour in zip(distances.items(), POLICY_COLOURS, strict=False):
        above.plot(*position[:, :2].T, color=colour, linewidth=1.3, label=team)
        error.plot(time, 100 * distance, color=colour, linewidth=1.3)
    above.set(xlabel="x [m]", ylabel="y [m]", title="from above", aspect="equal")
    error.set(xlabel="time [s]", ylabel="distance from the target [cm]", ylim=(0, None), title="error")
    for axes in (above, error):
        axes.grid(True, color="0.9", linewidth=0.8)
        axes.spines[["top", "right"]].set_visible(False)
    figure.legend(loc="outside lower center", ncols=4, frameon=False, fontsize=9)
    figure.savefig(path, dpi=160, format="png")


def row(team: str, errors: dict[str, float]) -> str:
    """Return a line of the table: cm, degrees, cm."""
    cells = [f"{100 * errors[axis]:.1f}" for axis in AXES[:3]] + [f"{errors[axis]:.2f}" for axis in AXES[3:]]
    return f"| {team} | {' | '.join(cells)} | {100 * errors['distance_m']:.1f} | {100 * errors['largest_m']:.0f} |"


def main(arguments: list[str]) -> None:
    """Evaluate, print, write and draw."""
    if not arguments or not Path(arguments[0]).is_dir():
        sys.exit(__doc__)
    if not all(each.isdecimal() and int(each) for each in arguments[1:2]):
        raise ConfigError(f"the number of episodes must be a whole one of at least 1, but is '{arguments[1]}'")
    time, reference, position, angles = read_published(Path(arguments[0]))
    distance = np.linalg.norm(position - reference, axis=1)
    parts = np.sqrt(np.mean(np.hstack([position - reference, angles]) ** 2, axis=0))
    theirs = dict(zip(AXES, map(float, parts), strict=True))
    theirs |= {"distance_m": float(np.sqrt(np.mean(distance**2))), "largest_m": float(distance.max())}
    file = ROOT / "runs" / "auto_multilift" / "fig8.npy"
    file.parent.mkdir(parents=True, exist_ok=True)
    np.save(file, np.column_stack([time, reference]))

    start = float(np.linalg.norm(position[0] - reference[0]))  # ours begin in a ball as large as their error there
    options = {"path": "file", "file": str(file), "rmse_from": 0.0, "start_radius": round(start, 3)}
    config = load_config("track_auto6", {f"task_options.{name}": value for name, value in options.items()})
    episodes = int(arguments[1]) if len(arguments) > 1 else 16
    nominal = fly(config, episodes)
    no_drag = fly(build_config(config.model_dump(), NO_DRAG), episodes)

    head = ("x [cm]", "y [cm]", "z [cm]", "roll [deg]", "pitch [deg]", "yaw [deg]", "distance [cm]", "largest [cm]")
    print(f"| | {' | '.join(head)} |\n|---|{'---|' * len(head)}")
    print(row("Auto-Multilift", theirs))
    for name, teams in (("", nominal), (", payload without drag", no_drag)):
        for team, errors in teams.items():
            print(row(team + name, errors))
    content = {"episodes": episodes, "seed": SEED, "published": theirs, "teams": nominal, "teams_without_drag": no_drag}
    (HERE / "auto_multilift.json").write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")

    drawn = {"Auto-Multilift (published flight)": (time, position, distance)}
    makers = make_teams(config)
    for team in DRAWN:
        trace: Trace = trace_episode(config, makers[team], 0, SEED)
        name = "learned, training seed 0" if team == "seed0" else team
        drawn[name] = (trace.time, trace.payload_position, trace.distance)
    draw(ROOT / "docs" / "images" / "auto_multilift.png", reference, drawn)


if __name__ == "__main__":
    run_script(main)
