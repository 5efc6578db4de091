"""`python train.py config=hover`, installed as `multilift-train`."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import Field

from multilift_marl import _ray
from multilift_marl._interrupt import ending_at_once, leave
from multilift_marl.command import (
    UNTRAINED,
    CommandOptions,
    join_command,
    run_command,
    spell_command,
    spell_modules,
    split_options,
    title,
)
from multilift_marl.config.load import load_config
from multilift_marl.errors import ConfigError

if TYPE_CHECKING:
    from multilift_marl.agents.trainer import Trainer
    from multilift_marl.config.config import Config

_USAGE = """Train a team.

  python train.py config=hover [key=value ...]     a new run in runs/<config>-<time>-s<seed>/
  python train.py resume=<run|latest>              go on with a run from its last checkpoint

task=<other> takes another task than the configuration's: config=rigs/auto6 task=track has the values of track, over
them env.num_drones, sim, vehicle, payload, cable, control and wind of rigs/auto6, over them the keys given here.
With --help, config=<name> and other keys show the values that they stand for."""

_RESUMABLE = (
    "train.frames", "train.checkpoint_every", "train.logger", "train.workers", "train.ray", "eval.every",
    "eval.episodes", "env.num_threads", "import",
)  # fmt: skip


class Options(CommandOptions):
    """Keys of the command beside those of the configuration."""

    config: str = Field("hover", description="a configuration's name or the path of a YAML file")
    resume: str | None = Field(
        None, description=f'a run folder, its name or "latest"; beside it only {", ".join(_RESUMABLE)}'
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Train; return the exit status."""
    if arguments is not None:
        return run_command(_train, _USAGE, Options, arguments)
    with ending_at_once():  # also by a second signal, after the training has been stopped by a first
        status = run_command(partial(_train, alone=True), _USAGE, Options, arguments)
        if status:  # what torch, Ray and others still do takes seconds on a busy machine
            leave(status)
    return status


def _train(values: dict[str, Any], alone: bool = False) -> int:
    """Train; `alone` says whether this process does nothing else, so that a signal may end it."""
    warnings.filterwarnings("ignore", module=r"torchrl|tensordict")
    sys.warnoptions.append("ignore:resource_tracker")  # of the process that cleans up after one that ends at once
    options, overrides = split_options(Options, values)
    config = load_config(options.config, overrides) if options.resume is None else None
    stored = "" if options.trust else "auto"  # of a run that is resumed: it may name a cluster where it is trusted
    if _ray.resolve(str(overrides.get("train.ray", stored)) if config is None else config.train.ray) != "local":
        _ray.use_token()
    from multilift_marl.agents.checkpoint import find_run
    from multilift_marl.agents.trainer import new_run, resume_run

    if config is None:
        assert options.resume is not None
        folder = find_run(options.resume)
        for key in values.keys() - {"resume", "trust"}:
            if key not in _RESUMABLE:
                raise ConfigError(
                    f"'{key}' cannot change when a run is resumed: start a new run, or give one of "
                    f"{', '.join(_RESUMABLE)}"
                )
        with ending_at_once():
            trainer = resume_run(folder, overrides)
        if trainer.finished:
            named = spell_modules(trainer.config) + _spell_cluster(trainer.config)
            more = spell_command("train", f"resume={folder}", *named, f"train.frames={2 * trainer.frames}")
            print(f"{folder} is finished, with {trainer.frames:,} steps; for more, say how many in all: {more}")
            return 0
        print(f"resuming {folder} at iteration {trainer.iteration} of {trainer.iterations}")
    else:
        _ = config.system  # refuse an impossible system before the long wait
        with ending_at_once():
            trainer = new_run(config, title(values))
        folder = trainer.folder
        print(f"training {config.train.frames:,} steps in {folder}")
        if trainer.taken_over:
            print(f"starting from {_beginning(trainer.config)} ({trainer.taken_over})")
    finished = trainer.run(ends=alone)
    minutes, modules = trainer.seconds / 60, spell_modules(trainer.config)
    if not finished and not (folder / "checkpoints" / "last.pt").is_file():
        print(f"stopped after {minutes:.1f} min, before the first checkpoint; start again")
        return trainer.status
    if not finished:
        again = spell_command("train", f"resume={folder}", *modules, *_spell_cluster(trainer.config))
        print(f"stopped after {minutes:.1f} min of training; go on with: {again}")
        if trainer.evaluator.best is not None and trainer.evaluator.best["iteration"] == 0:
            print(f"note: {UNTRAINED}")
        return trainer.status
    baseline = ["baseline=formation_integral"] if trainer.config.control.action == "reference" else []
    again = spell_command("evaluate", f"run={folder}", *modules, "episodes=200", "seed=1000", *baseline, "video=true")
    print(
        f"trained {trainer.frames:,} steps in {minutes:.1f} min\n"
        f"{_compare(trainer)}\n"
        f"curves:   {_curves(trainer.config, folder)}\n"
        f"evaluate: {again}"
    )
    return 0


def _spell_cluster(config: Config) -> list[str]:
    """Return the cluster of a run as an argument of a command that resumes it; none if it names none."""
    address = config.train.ray
    return [f"train.ray={address}"] if config.train.workers and address not in ("auto", "local") else []


def _curves(config: Config, folder: Path) -> str:
    """Return where the curves of a run are."""
    if config.train.logger == "tensorboard":
        return join_command("tensorboard", "--logdir", str(folder))
    return f"{folder / ('csv' if config.train.logger == 'csv' else 'wandb')}, {folder / 'metrics.csv'}"


def _beginning(config: Config) -> str:
    """Return what the policy is called that a training begins with."""
    from multilift_marl.agents.initial import short_name

    if config.train.init is not None:
        return short_name(config.train.init)
    return "zero actions" if config.train.residual == "formation" else config.train.residual


def _compare(trainer: Trainer) -> str:
    """Return a table of what training gained over the policy that it began with, and the verdict."""
    from multilift_marl.evaluation.metrics import name_error

    gain, best = trainer.gain, trainer.evaluator.best
    assert gain is not None and best is not None
    names = {
        f"before: {_beginning(trainer.config)}": gain.script,
        f"learned (iteration {best['iteration']})": gain.learned,
    }
    width = max(len(name) for name in names)
    metric = trainer.evaluator.error
    rows = [f"{'':{width}}  success  {name_error(metric):>14}"]
    for name, team in names.items():
        error = f"{100 * team[metric]:.2f} cm"
        rows.append(f"{name:{width}}  {team['success_rate']:>7.1%}  {error:>14}")
    if best["iteration"] == 0:
        verdict = "no significant difference: no policy was better than the one that training began with"
    elif gain.better:
        verdict = "better: the difference exceeds the noise"
    elif gain.worse:
        verdict = "worse: it was better in the episodes that decided, not in these"
    else:
        verdict = "no significant difference"
    return "\n".join([*rows, f"{verdict} (on {trainer.config.eval.episodes} episodes that decided nothing before)"])


if __name__ == "__main__":
    sys.exit(main())
