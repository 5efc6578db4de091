"""`python train.py config=hover`, installed as `multilift-train`."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from pydantic import Field

from multilift_marl.cli.common import UNTRAINED, run_command, spell_command, split_options, title
from multilift_marl.config.load import load_config
from multilift_marl.config.values import Section
from multilift_marl.errors import ConfigError

if TYPE_CHECKING:
    from multilift_marl.agents.trainer import Trainer

_USAGE = """Train a team.

  python train.py config=hover [key=value ...]     a new run in runs/<config>-<time>-s<seed>/
  python train.py resume=<run|latest>              go on with a run from its last checkpoint

task=<other> takes another task than the configuration's: config=rigs/auto6 task=track has the values of track, over
them env.num_drones, sim, vehicle, payload, cable, control and wind of rigs/auto6, over them the keys given here.
With --help, config=<name> and other keys show the values that they stand for."""

_RESUMABLE = (
    "train.frames", "train.checkpoint_every", "train.workers", "train.ray", "eval.every", "eval.episodes",
    "env.num_threads", "import",
)  # fmt: skip


class Options(Section):
    """Keys of the command beside those of the configuration."""

    config: str = Field("hover", description="a configuration's name or the path of a YAML file")
    resume: str | None = Field(
        None, description=f'a run folder, its name or "latest"; beside it only {", ".join(_RESUMABLE)}'
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Train; return the exit status."""
    return run_command(_train, _USAGE, Options, arguments)


def _train(values: dict[str, Any]) -> int:
    warnings.filterwarnings("ignore", module=r"torchrl|tensordict")
    from multilift_marl.agents.checkpoint import find_run
    from multilift_marl.agents.trainer import new_run, resume_run

    options, overrides = split_options(Options, values)
    if options.resume is not None:
        folder = find_run(options.resume)
        for key in values.keys() - {"resume"}:
            if key not in _RESUMABLE:
                raise ConfigError(
                    f"'{key}' cannot change when a run is resumed: start a new run, or give one of "
                    f"{', '.join(_RESUMABLE)}"
                )
        trainer = resume_run(folder, overrides)
        if trainer.finished:
            more = f"{spell_command('train')} resume={folder} train.frames={2 * trainer.frames}"
            print(f"{folder} is finished, with {trainer.frames:,} steps; for more, say how many in all: {more}")
            return 0
        print(f"resuming {folder} at iteration {trainer.iteration} of {trainer.iterations}")
    else:
        config = load_config(options.config, overrides)
        for key, value in config.train.overrides.items():
            if not any(given == key or given.startswith(f"{key}.") for given in overrides):
                continue
            print(f'note: training has {key}={value}, by train.overrides; "train.overrides={{{key}: ...}}" sets it')
        _ = config.system  # refuse an impossible system before the long wait
        trainer = new_run(config, title(values))
        folder = trainer.folder
        print(f"training {config.train.frames:,} steps in {folder}")
    finished = trainer.run()
    minutes = trainer.seconds / 60
    if not finished:
        print(f"stopped after {minutes:.1f} min of training; go on with: {spell_command('train')} resume={folder}")
        if trainer.evaluator.best is not None and trainer.evaluator.best["iteration"] == 0:
            print(f"note: {UNTRAINED}")
        return trainer.status
    baseline = " baseline=formation_integral" if trainer.config.control.action == "reference" else ""
    print(
        f"trained {trainer.frames:,} steps in {minutes:.1f} min\n"
        f"{_compare(trainer)}\n"
        f"curves:   tensorboard --logdir {folder}\n"
        f"evaluate: {spell_command('evaluate')} run={folder} episodes=200 seed=1000{baseline} video=true"
    )
    return 0


def _compare(trainer: Trainer) -> str:
    """Return what training gained over its script, in words."""
    gain, best = trainer.gain, trainer.evaluator.best
    assert gain is not None and best is not None
    script, learned = (
        f"position error {100 * team['payload_position_error_m']:.2f} cm, success {team['success_rate']:.1%}"
        for team in (gain.script, gain.learned)
    )
    text = (
        f"script {trainer.config.train.residual}: {script} -> learned: {learned} (best of iteration "
        f"{best['iteration']}, on {trainer.config.eval.episodes} fresh episodes)"
    )
    if best["iteration"] == 0:
        return f"{text}\nlearning gained nothing: no policy was better than the untrained one, which flies the script"
    if gain.better:
        return f"{text}\nlearning gained: the difference is beyond the noise of these episodes"
    return f"{text}\nlearning gained nothing: the difference is not beyond the noise"


if __name__ == "__main__":
    sys.exit(main())
