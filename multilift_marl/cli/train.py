"""`python train.py config=hover`, installed as `multilift-train`."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from multilift_marl.cli.common import run_command, title
from multilift_marl.config.load import load_config
from multilift_marl.errors import ConfigError

if TYPE_CHECKING:
    from multilift_marl.agents.trainer import Trainer

_USAGE = """Train a team.

  python train.py config=hover [key=value ...]     a new run in runs/<config>-<time>-s<seed>/
  python train.py resume=<run|latest>              go on with a run from its last checkpoint

  config   a configuration's name or the path of a YAML file (default hover)
  task     another task than the configuration's: config=rigs/auto6 task=track has the values of track, over them
           env.num_drones, sim, vehicle, payload, cable, control and wind of rigs/auto6, over them the keys given here
  import   a module of one's own, name or .py file: tasks, vehicles, configurations (docs/plugins.md)
  resume   a run folder; takes only train.frames, train.checkpoint_every, eval.*, env.num_threads, import beside it

With --help, config=<name> and other keys show the values that they stand for."""

_RESUMABLE = ("train.frames", "train.checkpoint_every", "eval.every", "eval.episodes", "env.num_threads", "import")

_NAMES = ("config", "resume")


def main(arguments: Sequence[str] | None = None) -> int:
    """Train; return the exit status."""
    return run_command(_train, _USAGE, _NAMES, arguments, names=_NAMES)


def _train(values: dict[str, Any]) -> int:
    warnings.filterwarnings("ignore", module=r"torchrl|tensordict")
    from multilift_marl.agents.checkpoint import find_run
    from multilift_marl.agents.trainer import new_run, resume_run

    if "resume" in values:
        folder = find_run(values.pop("resume"))
        for key in values:
            if key not in _RESUMABLE:
                raise ConfigError(
                    f"'{key}' cannot change when a run is resumed: start a new run, or give one of "
                    f"{', '.join(_RESUMABLE)}"
                )
        trainer = resume_run(folder, values)
        if trainer.finished:
            more = f"python train.py resume={folder} train.frames={2 * trainer.frames}"
            print(f"{folder} is finished, with {trainer.frames:,} steps; for more, say how many in all: {more}")
            return 0
        print(f"resuming {folder} at iteration {trainer.iteration} of {trainer.iterations}")
    else:
        name = title(values)
        config = load_config(str(values.pop("config", "hover")), values)
        _ = config.system  # refuse an impossible system before the long wait
        trainer = new_run(config, name)
        folder = trainer.folder
        print(f"training {config.train.frames:,} steps in {folder}")
    finished = trainer.run()
    minutes = trainer.seconds / 60
    if not finished:
        print(f"stopped after {minutes:.1f} min of training; go on with: python train.py resume={folder}")
        return trainer.status
    baseline = "formation_integral" if trainer.config.control.action == "reference" else "none"
    print(
        f"trained {trainer.frames:,} steps in {minutes:.1f} min\n"
        f"{_compare(trainer)}\n"
        f"curves:   tensorboard --logdir {folder}\n"
        f"evaluate: python evaluate.py run={folder} episodes=200 seed=1000 baseline={baseline} video=true"
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
    return text if gain.better else f"{text}\nlearning gained nothing: the difference is not beyond the noise"


if __name__ == "__main__":
    sys.exit(main())
