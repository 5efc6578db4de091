"""Train the recipes, judge learned and scripted teams on the same episodes, and rebuild the tables from what they did.

  python results/reproduce.py train gate [seed ...]     train configs/gate.yaml; keep curve and weights in results/gate/
  python results/reproduce.py keep gate runs/<run>      the same of a run that is there already
  python results/reproduce.py judge [flight ...]        1000 episodes of every learned team, the first 200 of them of
                                                        every script -> results/<flight>/<team>.json
  python results/reproduce.py ship [recipe ...]         put the weights of seed 0 into the package
  python results/reproduce.py table                     the tables of README.md and docs/tasks.md

Every number in those tables comes from these files; `judge` skips files that are there already.
"""

from __future__ import annotations

import csv
import json
import re
import sys
from pathlib import Path
from typing import Any, NamedTuple

from multilift_marl.config.load import build_config, load_config
from multilift_marl.control.scripted import SCRIPTED, fitting_scripts, make_scripted
from multilift_marl.envs.core import MultiliftVec
from multilift_marl.evaluation.metrics import summarize
from multilift_marl.evaluation.rollout import fly_episodes

HERE, ROOT = Path(__file__).parent, Path(__file__).parents[1]
EPISODES, SEED = {"learned": 1000, "script": 200}, 1000
FASTER = {"task_options.speed": 2.0, "task_options.acceleration": 2.0}
AGILE = {"task_options.speed": 2.0, "task_options.acceleration": 4.0}
FASTEST = {"task_options.speed": 5.0, "task_options.acceleration": 8.0}

ESTIMATED = "load without sensor"  # what differs with the published figures, briefly; docs/track.md, docs/recover.md
AUTO = "41 cm: path of 2.8 m/s², start included; MPC, no motor lag, no drag"
CRAZYMARL = "79.7 %: motor commands, noise, pushes"


class Flight(NamedTuple):
    """A row of the table."""

    config: str
    overrides: dict[str, Any]
    recipe: str
    """Whose policies fly it."""
    title: str
    published: str = ""


FLIGHTS: dict[str, Flight] = {
    "hover": Flight("hover", {}, "hover", "hover"),
    "hover_wind": Flight("hover_wind", {}, "hover_wind", "hover in wind of 5 m/s, noise, delay"),
    "pose_easy": Flight("pose_easy", {}, "pose", "pose, tilts to 20°"),
    "pose": Flight("pose", {}, "pose", "pose, tilts to 45°"),
    "pose_falcon3": Flight("pose_falcon3", {}, "pose_falcon3", "pose, three drones, tilts to 45°"),
    "pose_wind": Flight("pose_wind", {}, "pose_wind", "pose, tilts to 45°, in wind of 5 m/s, noise, delay"),
    "circle_slow": Flight("track_circle", {}, "track_circle", "circle, 0.2 rad/s"),
    "circle_fast": Flight("track_circle", {"task_options.rate": 0.4}, "track_circle", "circle, 0.4 rad/s"),
    "track": Flight("track", {}, "track", "figure-eight, 1 m/s, 0.5 m/s²", f"3.2 cm: geometric control, {ESTIMATED}"),
    "track_2_2": Flight("track", FASTER, "track", "figure-eight, 2 m/s, 2 m/s²", f"9.3 cm: 10 Hz planner, {ESTIMATED}"),
    "track_2_4": Flight("track", AGILE, "track", "figure-eight, 2 m/s, 4 m/s²", f"11.7 cm: 10 Hz planner, {ESTIMATED}"),
    "track_5_8": Flight(
        "track", FASTEST, "track", "figure-eight, 5 m/s, 8 m/s²", f"19.7 cm: 10 Hz planner, {ESTIMATED}"
    ),
    "track_auto6": Flight("track_auto6", {}, "track_auto6", "figure-eight, 4.5 m/s, 4 m/s², six drones, 7 kg", AUTO),
    "takeoff": Flight("takeoff", {}, "takeoff", "takeoff"),
    "land": Flight("land", {}, "land", "land"),
    "gate": Flight("gate", {}, "gate", "gate"),
    "gate_two": Flight("gate_two", {}, "gate", "two gates"),
    "recover": Flight("recover", {}, "recover", "recover"),
    "recover_crazymarl": Flight("recover_crazymarl", {}, "recover_crazymarl", "recover, CrazyMARL's starts", CRAZYMARL),
    "loss": Flight("loss", {}, "loss", "loss, 4 drones"),
    "loss_6": Flight("loss_6", {}, "loss_6", "loss, 6 drones"),
    "loss_snap": Flight("loss_snap", {}, "loss", "loss with its cable"),
}


def train(recipe: str, seeds: list[int]) -> None:
    """Train a recipe on some seeds and keep what came of each."""
    from multilift_marl.agents.trainer import new_run

    for seed in seeds:
        trainer = new_run(load_config(recipe, {"seed": seed}), recipe)
        if not trainer.run():
            sys.exit(
                f"stopped; go on with: python train.py resume={trainer.folder}, then keep it with: "
                f"python results/reproduce.py keep {recipe} {trainer.folder}"
            )
        keep(recipe, trainer.folder)


def keep(recipe: str, run: Path) -> None:
    """Keep curve, duration and best weights of a run in results/<recipe>/seed<seed>/."""
    from multilift_marl.agents.checkpoint import load_checkpoint
    from multilift_marl.agents.logging import read_metrics
    from multilift_marl.agents.policy import strip_checkpoint
    from multilift_marl.evaluation.plots import plot_training

    rows, last = read_metrics(run), load_checkpoint(run / "checkpoints" / "last.pt")
    folder = HERE / recipe / f"seed{last['config']['seed']}"
    folder.mkdir(parents=True, exist_ok=True)
    names = ("frames", "return", *(name for name in rows[0] if name.startswith("eval/")))
    with open(folder / "curve.csv", "w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, names, extrasaction="ignore")
        writer.writeheader()
        writer.writerows(row for row in rows if row["eval/success_rate"] != "")
    told = {"frames": last["frames"], "minutes": round(last["seconds"] / 60, 1)}
    (folder / "training.json").write_text(json.dumps(told) + "\n", encoding="utf-8")
    plot_training(folder / "training.png", rows)
    strip_checkpoint(run / "checkpoints" / "best.pt", folder / "policy.pt")


def judge(flights: list[str]) -> None:
    """Fly what has not been flown yet."""
    import torch

    from multilift_marl.agents.policy import load_policy

    torch.set_num_threads(1)  # for networks this small, more of them only wait for each other
    for name in flights:
        flight, folder = FLIGHTS[name], HERE / name
        config = load_config(flight.config, flight.overrides)
        probe = MultiliftVec(build_config(config.model_dump(), {"env.num_envs": 1}))
        scripts = fitting_scripts(probe)
        teams = {script: (lambda vec, script=script: make_scripted(script, vec)) for script in scripts}
        for weights in sorted((HERE / flight.recipe).glob("seed*/policy.pt")):
            policy = load_policy(weights)
            teams[weights.parent.name] = policy.bind
        for team, maker in teams.items():
            path, episodes = folder / f"{team}.json", EPISODES["script" if team in scripts else "learned"]
            if path.is_file() and json.loads(path.read_text(encoding="utf-8"))["episodes"] == episodes:
                continue
            told = summarize(fly_episodes(config, maker, episodes, SEED))
            folder.mkdir(parents=True, exist_ok=True)
            content = {"episodes": episodes, "seed": SEED, "config": flight.config, "overrides": flight.overrides}
            path.write_text(json.dumps(content | {"metrics": told}, indent=1) + "\n", encoding="utf-8")
            print(f"{name}, {team}: success {told['success_rate']['mean']:.1%}", flush=True)


def ship(recipes: list[str]) -> None:
    """Copy the weights of seed 0 to where `ml.load_policy` finds them."""
    for recipe in recipes:
        shipped = ROOT / "multilift_marl" / "policies" / f"{recipe}.pt"
        shipped.write_bytes((HERE / recipe / "seed0" / "policy.pt").read_bytes())


def table() -> str:
    """Return all flights as a Markdown table: success and error of each team, of learned ones the mean of all seeds."""
    columns = ("learned", "training seeds", *SCRIPTED)
    lines = [
        f"| | {' | '.join(columns)} | published |",
        f"|---|{'---|' * (len(columns) + 1)}",
    ]
    for name, flight in FLIGHTS.items():
        error = "payload_rmse_m" if flight.config.startswith("track") else "payload_position_error_m"
        seeds = sorted((HERE / name).glob("seed*.json"))
        scripts = [_cell([HERE / name / f"{script}.json"], error) for script in SCRIPTED]
        cells = [_cell(seeds, error), str(len(seeds)), *scripts, flight.published]
        lines.append(f"| {flight.title} | {' | '.join(cells)} |")
    return "\n".join(lines)


def _cell(paths: list[Path], error: str) -> str:
    """Return "success %, error cm", means of these results, with the smallest and the largest where they differ."""
    told = [json.loads(path.read_text(encoding="utf-8"))["metrics"] for path in paths if path.is_file()]
    if not told:
        return "-"
    parts = []
    for metric, unit, digits in (("success_rate", "%", 1), (error, "cm", 2)):
        values = [100 * one[metric]["mean"] for one in told]
        least, most = (f"{value:.{digits}f}" for value in (min(values), max(values)))
        spread = f" ({least} - {most})" if least != most else ""
        parts.append(f"{sum(values) / len(values):.{digits}f}{spread} {unit}")
    return ", ".join(parts)


def write_tables() -> None:
    """Replace what stands between the markers in the documents."""
    for path in (ROOT / "README.md", ROOT / "docs" / "tasks.md"):
        text = path.read_text(encoding="utf-8")
        marked = re.compile(r"(<!-- results -->\n).*?(<!-- end of results -->)", re.DOTALL)
        path.write_text(marked.sub(lambda found: f"{found[1]}{table()}\n{found[2]}", text), encoding="utf-8")


def main(arguments: list[str]) -> None:
    """Do what is asked."""
    what, *rest = arguments or ["help"]
    if what == "train" and rest:
        train(rest[0], [int(seed) for seed in rest[1:]] or [0])
    elif what == "keep" and len(rest) == 2:
        keep(rest[0], Path(rest[1]))
    elif what == "judge":
        judge(rest or list(FLIGHTS))
    elif what == "ship" and rest:
        ship(rest)
    elif what == "table":
        write_tables()
    else:
        sys.exit(__doc__)


if __name__ == "__main__":
    main(sys.argv[1:])
