"""Train the recipes, evaluate learned policies and baselines on the same episodes, and rebuild the tables.

  python results/reproduce.py train gate [seed ...]     train configs/gate.yaml; keep curve and weights in results/gate/
  python results/reproduce.py keep gate runs/<run>      the same for an existing run
  python results/reproduce.py evaluate [flight ...]     the same 1000 episodes of every learned policy and baseline
                                                        -> results/<flight>/<team>.json, .npz; also <flight>/<team>
                                                        for one team, workers=<processes> (as many as there are CPUs)
  ... ray=local|<address>                               train or evaluate in processes of Ray, also of a cluster whose
                                                        nodes share this folder (docs/ray.md)
  python results/reproduce.py ship [recipe ...]         put the weights of seed 0 into the package
  python results/reproduce.py table                     docs/results.md, docs/data/results.csv, shifts.csv

Every number in those tables comes from these files. `evaluate` skips teams whose files exist, so it can be stopped
and started again; delete the files of what has changed.
"""

from __future__ import annotations

import csv
import io
import json
import multiprocessing
import os
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from flights import FLIGHTS, HERE, MPC, OWN_PLANNERS, ROOT, SCRIPTED, SEED, episodes_of, error_metric
from script import check_known, read_options, run_script
from searched import SEARCHED, settings_of
from tables import write_tables

from multilift_marl._files import write_whole
from multilift_marl._platform import cpu_count
from multilift_marl._ray import connect, disconnect, get
from multilift_marl._versions import find_versions
from multilift_marl.config.config import Config
from multilift_marl.config.load import build_config, load_config
from multilift_marl.envs.core import MultiliftVec
from multilift_marl.errors import ConfigError
from multilift_marl.evaluation.metrics import summarize
from multilift_marl.evaluation.rollout import run_episodes
from multilift_marl.policies.baselines import fitting_scripts, make_scripted
from multilift_marl.tasks import find_task


def train(recipe: str, seeds: list[int], workers: int, address: str = "") -> None:
    """Train a recipe on some seeds and keep the result of each; with Ray, several at a time."""
    if address:
        for line in spread_by_ray(partial(train_seed, recipe), seeds, workers, address):
            print(line, flush=True)
    else:
        for seed in seeds:
            train_seed(recipe, seed)


def train_seed(recipe: str, seed: int) -> str:
    """Train a recipe on one seed and keep the result."""
    from multilift_marl.agents.trainer import new_run

    trainer = new_run(load_config(recipe, {"seed": seed}), recipe)
    if not trainer.run():
        sys.exit(
            f"stopped; continue with: python train.py resume={trainer.folder}, then keep it with: "
            f"python results/reproduce.py keep {recipe} {trainer.folder}"
        )
    keep(recipe, trainer.folder)
    return f"{recipe}, seed {seed}: {trainer.seconds / 60:.1f} min"


def keep(recipe: str, run: Path) -> None:
    """Keep curve, duration and best weights of a run in results/<recipe>/seed<seed>/."""
    from multilift_marl.agents.checkpoint import load_checkpoint, save_checkpoint
    from multilift_marl.agents.logging import read_metrics
    from multilift_marl.agents.policy import strip_checkpoint
    from multilift_marl.evaluation.plots import plot_training

    rows = read_metrics(run)
    last = load_checkpoint(run / "checkpoints" / "last.pt")
    folder = HERE / recipe / f"seed{last['config']['seed']}"
    folder.mkdir(parents=True, exist_ok=True)
    names = ("frames", "return", *(name for name in rows[0] if name.startswith("eval/")))
    with open(folder / "curve.csv", "w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, names, extrasaction="ignore")
        writer.writeheader()
        writer.writerows(row for row in rows if row["eval/success_rate"] != "")
    duration = {"frames": last["frames"], "minutes": round(last["seconds"] / 60, 1)}
    (folder / "training.json").write_text(json.dumps(duration) + "\n", encoding="utf-8")
    plot_training(folder / "training.png", rows, metric=find_task(load_config(recipe).task).ERROR)
    strip_checkpoint(run / "checkpoints" / "best.pt", folder / "policy.pt")
    kept = load_checkpoint(folder / "policy.pt")  # a run that was resumed may have got more frames since
    save_checkpoint(folder / "policy.pt", kept | {"config": last["config"]})


class Job(NamedTuple):
    """A policy and the row of the table that it is evaluated for."""

    flight: str
    team: str
    weights: str
    """Path of a learned policy's; "" for a baseline."""

    @property
    def files(self) -> tuple[Path, Path]:
        """Metrics, and success and error of each episode."""
        folder = HERE / self.flight
        return folder / f"{self.team}.json", folder / f"{self.team}.npz"

    @property
    def done(self) -> bool:
        """Whether both files are there, for as many episodes."""
        metrics, episodes = self.files
        if not (episodes.is_file() and metrics.is_file()):
            return False
        return bool(json.loads(metrics.read_text())["episodes"] == episodes_of(self.team))


def evaluate(flights: list[str], workers: int, address: str = "") -> None:
    """Evaluate the policies without results, one in each process at a time."""
    jobs = [job for each in flights for job in list_jobs(*each.split("/", 1)) if not job.done]
    jobs = list(dict.fromkeys(jobs))
    if address:
        for line in spread_by_ray(fly, jobs, workers, address):
            print(line, flush=True)
        return
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, mp_context=spawn, initializer=end_with_parent) as pool:
        for done in as_completed([pool.submit(fly, job) for job in jobs]):
            print(done.result(), flush=True)


def end_with_parent() -> None:
    """Let this process end as soon as the one that has started it is gone, however that ended."""
    parent = multiprocessing.parent_process()
    assert parent is not None

    def watch() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def spread_by_ray(function: Callable[[Any], str], jobs: list[Any], workers: int, address: str) -> Iterator[str]:
    """Call `function` with each job in a process of Ray, at most `workers` at a time; yield results as they come."""
    import ray
    from ray import cloudpickle

    cloudpickle.register_pickle_by_value(sys.modules[__name__])  # other processes cannot import this file
    owns = connect(address, workers, "ray")
    waiting, running = [cloudpickle.dumps((function, job)) for job in jobs], list[Any]()
    task = ray.remote(num_cpus=1, max_retries=0, max_calls=1)(_call_here)
    try:
        while waiting or running:
            while waiting and len(running) < workers:
                running.append(task.remote(waiting.pop(0), str(ROOT), str(HERE), find_versions()))
            done, running = ray.wait(running)
            yield get(done[0])
    finally:
        for each in running:  # an interrupted training saves its checkpoint
            ray.cancel(each)
        if running:
            ray.wait(running, num_returns=len(running), timeout=60)
        if owns:
            disconnect()


def _call_here(content: bytes, root: str, scripts: str, versions: dict[str, str]) -> str:
    """Call a pickled function with its job, in a process of Ray, as if it were one of this script."""
    from ray import cloudpickle

    from multilift_marl._ray import check_versions

    os.chdir(root)
    sys.path.insert(0, scripts)
    check_versions(versions)
    function, job = cloudpickle.loads(content)
    return str(function(job))


def list_jobs(flight: str, only: str = "") -> list[Job]:
    """Return the policies of a flight, or the one called `only`; a ConfigError if there is none."""
    check_known("flight", [flight], FLIGHTS)
    config = load_config(FLIGHTS[flight].config, FLIGHTS[flight].overrides)
    scripts = fitting_scripts(MultiliftVec(build_config(config.model_dump(), SCRIPTED | {"env.num_envs": 1})))
    weights = sorted((HERE / FLIGHTS[flight].recipe).glob("seed*/policy.pt"))
    scripts += ["searched"] if flight in SEARCHED else []
    scripts = [name for name in scripts if name in (FLIGHTS[flight].scripts or scripts)]
    scripts += ["mpc"] if can_plan(config) else []
    jobs = [*(Job(flight, name, "") for name in scripts), *(Job(flight, w.parent.name, str(w)) for w in weights)]
    check_known(f"team of {flight}", [only] if only else [], [job.team for job in jobs])
    return [job for job in jobs if only in ("", job.team)]


def can_plan(config: Config) -> bool:
    """Return whether the central planner can fly an environment."""
    try:
        make_scripted("mpc", MultiliftVec(build_config(config.model_dump(), MPC | {"env.num_envs": 1})))
    except ConfigError:
        return False
    return True


def planner_of(flight: str) -> dict[str, Any]:
    """Return the settings of the central planner."""
    return MPC | OWN_PLANNERS.get(flight, {})


def fly(job: Job) -> str:
    """Simulate a policy's episodes, write the results, and return a line about them."""
    import torch

    from multilift_marl.agents.policy import load_policy

    torch.set_num_threads(1)  # for networks this small, more of them only wait for each other
    flight = FLIGHTS[job.flight]
    overrides = flight.overrides | {"env.num_threads": 1}
    maker: Callable[[MultiliftVec], Any] = partial(make_scripted, job.team)
    if job.team == "searched":
        maker = SEARCHED[job.flight]
    if job.weights:
        policy = load_policy(job.weights)
        scales = {f"control.{key}": getattr(policy.config.control, key) for key in ("max_offset", "max_yaw")}
        # the full scale of actions is that of training
        maker = policy.bind
        overrides = overrides | scales
    else:
        settings = {"searched": settings_of, "mpc": planner_of}.get(job.team, lambda _: SCRIPTED)
        overrides = overrides | settings(job.flight)
    results = run_episodes(load_config(flight.config, overrides), maker, episodes_of(job.team), SEED)
    metrics = summarize(results)
    error = results[error_metric(flight)]
    content = {"episodes": episodes_of(job.team), "seed": SEED, "config": flight.config, "overrides": flight.overrides}
    if job.team == "mpc":
        content["overrides"] = flight.overrides | OWN_PLANNERS.get(job.flight, {})
    report, episodes = job.files
    report.parent.mkdir(parents=True, exist_ok=True)
    arrays = io.BytesIO()
    np.savez_compressed(arrays, success=results["success_rate"], error=error.astype(np.float32))
    write_whole(report, f"{json.dumps(content | {'metrics': metrics}, indent=1)}\n".encode())
    write_whole(episodes, arrays.getbuffer())
    return f"{job.flight}, {job.team}: success {metrics['success_rate']['mean']:.1%}, {100 * error.mean():.2f} cm"


def ship(recipes: list[str]) -> None:
    """Copy the weights of seed 0 to where `ml.load_policy` finds them."""
    for recipe in recipes:
        kept, shipped = HERE / recipe / "seed0" / "policy.pt", ROOT / "multilift_marl" / "policies" / f"{recipe}.pt"
        if not kept.is_file():
            raise ConfigError(f"there is no {kept}; train it first: python results/reproduce.py train {recipe}")
        shipped.write_bytes(kept.read_bytes())


def main(arguments: list[str]) -> None:
    """Run the named command."""
    what, *rest = [each for each in arguments if "=" not in each] or ["help"]
    options = read_options([each for each in arguments if "=" in each], {"workers": cpu_count(), "ray": ""})
    workers, address = options["workers"], options["ray"]
    if what == "train" and rest:
        if wrong := [seed for seed in rest[1:] if not seed.isdecimal()]:
            raise ConfigError(f"seeds must be whole numbers, but one is '{wrong[0]}'")
        train(rest[0], [int(seed) for seed in rest[1:]] or [0], workers, address)
    elif what == "keep" and len(rest) == 2:
        keep(rest[0], Path(rest[1]))
    elif what == "evaluate":
        evaluate(rest or list(FLIGHTS), workers, address)
    elif what == "ship" and rest:
        ship(rest)
    elif what == "table":
        write_tables()
    else:
        sys.exit(__doc__)


if __name__ == "__main__":
    run_script(main)
