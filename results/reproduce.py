"""Train the recipes, judge learned and scripted teams on the same episodes, and rebuild the tables from what they did.

  python results/reproduce.py train gate [seed ...]     train configs/gate.yaml; keep curve and weights in results/gate/
  python results/reproduce.py keep gate runs/<run>      the same of a run that is there already
  python results/reproduce.py judge [flight ...]        the same 1000 episodes of every learned team and every script
                                                        -> results/<flight>/<team>.json, .npz; also <flight>/<team>
                                                        for one team, workers=<processes> (as many as there are CPUs)
  python results/reproduce.py ship [recipe ...]         put the weights of seed 0 into the package
  python results/reproduce.py table                     the tables of README.md and docs/tasks.md

Every number in those tables comes from these files. `judge` skips teams whose files are there already, so it can be
stopped and started again; delete the files of what has changed.
"""

from __future__ import annotations

import csv
import json
import multiprocessing
import os
import re
import sys
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor, as_completed
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from multilift_marl.config.load import build_config, load_config
from multilift_marl.control.scripted import SCRIPTED, fitting_scripts, make_scripted
from multilift_marl.envs.core import MultiliftVec
from multilift_marl.evaluation.metrics import bootstrap, is_gain, summarize
from multilift_marl.evaluation.rollout import fly_episodes

HERE, ROOT = Path(__file__).parent, Path(__file__).parents[1]
EPISODES, SEED = 1000, 1000
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


class Job(NamedTuple):
    """A team and what it flies."""

    flight: str
    team: str
    weights: str
    """Path of a learned team's; "" for a script."""

    @property
    def files(self) -> tuple[Path, Path]:
        """Metrics, and success and error of each episode."""
        folder = HERE / self.flight
        return folder / f"{self.team}.json", folder / f"{self.team}.npz"

    @property
    def done(self) -> bool:
        """Whether both files are there, for as many episodes."""
        told, episodes = self.files
        return episodes.is_file() and told.is_file() and json.loads(told.read_text("utf-8"))["episodes"] == EPISODES


def judge(asked: list[str], workers: int) -> None:
    """Fly what has not been flown yet, one team in each process at a time."""
    jobs = [job for each in asked for job in list_jobs(*each.split("/", 1)) if not job.done]
    jobs = list(dict.fromkeys(jobs))
    with ProcessPoolExecutor(workers, mp_context=multiprocessing.get_context("spawn")) as pool:
        for told in as_completed([pool.submit(fly, job) for job in jobs]):
            print(told.result(), flush=True)


def list_jobs(flight: str, only: str = "") -> list[Job]:
    """Return the teams that fly a flight, or the one called `only`."""
    config = load_config(FLIGHTS[flight].config, FLIGHTS[flight].overrides)
    scripts = fitting_scripts(MultiliftVec(build_config(config.model_dump(), {"env.num_envs": 1})))
    weights = sorted((HERE / FLIGHTS[flight].recipe).glob("seed*/policy.pt"))
    jobs = [*(Job(flight, name, "") for name in scripts), *(Job(flight, w.parent.name, str(w)) for w in weights)]
    return [job for job in jobs if only in ("", job.team)]


def fly(job: Job) -> str:
    """Fly a team, write what it did, and return a line about it."""
    import torch

    from multilift_marl.agents.policy import load_policy

    torch.set_num_threads(1)  # for networks this small, more of them only wait for each other
    flight = FLIGHTS[job.flight]
    overrides = flight.overrides | {"env.num_threads": 1}
    maker: Callable[[MultiliftVec], Any] = partial(make_scripted, job.team)
    if job.weights:
        policy = load_policy(job.weights)
        scales = {f"control.{key}": getattr(policy.config.control, key) for key in ("max_offset", "max_yaw")}
        maker, overrides = policy.bind, overrides | scales  # a full action means what it did in training
    flown = fly_episodes(load_config(flight.config, overrides), maker, EPISODES, SEED)
    metrics, error = summarize(flown), flown[error_metric(flight)]
    content = {"episodes": EPISODES, "seed": SEED, "config": flight.config, "overrides": flight.overrides}
    told, episodes = job.files
    told.parent.mkdir(parents=True, exist_ok=True)
    unfinished = episodes.with_suffix(".part.npz")  # a stopped process leaves no file that looks whole
    np.savez_compressed(unfinished, success=flown["success_rate"], error=error.astype(np.float32))
    told.write_text(json.dumps(content | {"metrics": metrics}, indent=1) + "\n", encoding="utf-8")
    unfinished.replace(episodes)
    return f"{job.flight}, {job.team}: success {metrics['success_rate']['mean']:.1%}, {100 * error.mean():.2f} cm"


def error_metric(flight: Flight) -> str:
    """Return the metric by which the teams of a flight are compared."""
    return "payload_rmse_m" if flight.config.startswith("track") else "payload_position_error_m"


def ship(recipes: list[str]) -> None:
    """Copy the weights of seed 0 to where `ml.load_policy` finds them."""
    for recipe in recipes:
        shipped = ROOT / "multilift_marl" / "policies" / f"{recipe}.pt"
        shipped.write_bytes((HERE / recipe / "seed0" / "policy.pt").read_bytes())


def table() -> str:
    """Return all flights and all teams as a Markdown table: success and error, of learned ones the mean of seeds."""
    rows = []
    for name, flight in FLIGHTS.items():
        scripts = [_cell([HERE / name / f"{script}.json"], error_metric(flight)) for script in SCRIPTED]
        rows.append([flight.title, *_learned(name), gain(name), *scripts, flight.published])
    return _markdown(["learned", "training seeds", "learned - best script", *SCRIPTED, "published"], rows)


def summary() -> str:
    """Return the same of the learned teams and the best script of each flight alone."""
    rows = []
    for name, flight in FLIGHTS.items():
        best = best_script(name)
        script = f"{best}: {_cell([HERE / name / f'{best}.json'], error_metric(flight))}" if best else "-"
        difference = gain(name).replace(f", {best}", "")
        rows.append([flight.title, *_learned(name), script, difference, flight.published])
    return _markdown(["learned", "training seeds", "best script", "learned - best script", "published"], rows)


def _learned(flight: str) -> tuple[str, str]:
    """Return what learned teams did, and how many."""
    seeds = sorted((HERE / flight).glob("seed*.json"))
    fresh = [path for path in seeds if path.with_suffix(".npz").is_file()]
    return _cell(seeds, error_metric(FLIGHTS[flight])), str(len(fresh or seeds))


def _markdown(columns: list[str], rows: list[list[str]]) -> str:
    """Return a table of which the first column has no name."""
    head = [f"| | {' | '.join(columns)} |", f"|---|{'---|' * len(columns)}"]
    return "\n".join(head + [f"| {' | '.join(row)} |" for row in rows])


def best_script(flight: str) -> str:
    """Return the script with the most successes, of several the one with the least error; "" if none was flown."""
    scripts = {name: np.load(path) for name in SCRIPTED if (path := HERE / flight / f"{name}.npz").is_file()}
    return min(scripts, default="", key=lambda name: (-scripts[name]["success"].mean(), scripts[name]["error"].mean()))


def gain(flight: str) -> str:
    """Return what learned teams do better than the best script: success and error, paired by episode.

    Of several training seeds each episode counts by its mean. `is_gain` says whether learning gains.
    """
    learned = [np.load(path) for path in sorted((HERE / flight).glob("seed*.npz")) if "." not in path.stem]
    best = best_script(flight)
    if not learned or not best:
        return "-"
    script = np.load(HERE / flight / f"{best}.npz")
    parts, differences = [], []
    for key, unit, digits in (("success", "points", 1), ("error", "cm", 2)):
        mean = np.mean([each[key].astype(float) for each in learned], axis=0)
        difference = 100 * (mean - script[key].astype(float))
        differences.append(difference)
        low, high = (f"{bound:+.{digits}f}" for bound in bootstrap(difference))
        parts.append(f"{difference.mean():+.{digits}f} ({low} to {high}) {unit}")
    return f"{', '.join(parts)}, {best}" + ("" if is_gain(*differences) else "; **learning gains nothing**")


def _cell(paths: list[Path], error: str) -> str:
    """Return "success %, error cm", means of these results, with the smallest and the largest where they differ.

    Results without their episodes are older than today's physics, and marked by a dagger where there are no others.
    """
    fresh = [path for path in paths if path.with_suffix(".npz").is_file()]
    told = [json.loads(path.read_text(encoding="utf-8"))["metrics"] for path in fresh or paths if path.is_file()]
    if not told:
        return "-"
    parts = []
    for metric, unit, digits in (("success_rate", "%", 1), (error, "cm", 2)):
        values = [100 * one[metric]["mean"] for one in told]
        least, most = (f"{value:.{digits}f}" for value in (min(values), max(values)))
        spread = f" ({least} - {most})" if least != most else ""
        parts.append(f"{sum(values) / len(values):.{digits}f}{spread} {unit}")
    return ", ".join(parts) + ("" if fresh else " †")


def write_tables() -> None:
    """Replace what stands between the markers in the documents."""
    for path, content in ((ROOT / "README.md", summary()), (ROOT / "docs" / "tasks.md", table())):
        text = path.read_text(encoding="utf-8")
        marked = re.compile(r"(<!-- results -->\n).*?(<!-- end of results -->)", re.DOTALL)
        replaced = marked.sub(lambda found, content=content: f"{found[1]}{content}\n{found[2]}", text)
        path.write_text(replaced, encoding="utf-8")


def main(arguments: list[str]) -> None:
    """Do what is asked."""
    what, *rest = arguments or ["help"]
    if what == "train" and rest:
        train(rest[0], [int(seed) for seed in rest[1:]] or [0])
    elif what == "keep" and len(rest) == 2:
        keep(rest[0], Path(rest[1]))
    elif what == "judge":
        workers = [int(each.partition("=")[2]) for each in rest if each.startswith("workers=")]
        flights = [each for each in rest if not each.startswith("workers=")]
        judge(flights or list(FLIGHTS), workers[-1] if workers else len(os.sched_getaffinity(0)))
    elif what == "ship" and rest:
        ship(rest)
    elif what == "table":
        write_tables()
    else:
        sys.exit(__doc__)


if __name__ == "__main__":
    main(sys.argv[1:])
