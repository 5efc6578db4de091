"""`python train.py config=hover`, installed as `multilift-train`."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Sequence
from typing import Any

from multilift_marl.cli.common import announce_compiling, run_command, title
from multilift_marl.config.load import load_config
from multilift_marl.errors import ConfigError

_USAGE = """Train a team.

  python train.py config=hover [key=value ...]     a new run in runs/<config>-<time>-s<seed>/
  python train.py resume=<run|latest>              go on with a run from its last checkpoint

  config   a configuration's name or the path of a YAML file (default hover)
  task     another task than the configuration's: config=rigs/auto6 task=track has the values of track, over them
           env.num_drones, sim, vehicle, payload, cable, control and wind of rigs/auto6, over them the keys given here
  import   a module of one's own, name or .py file: tasks, vehicles, configurations (docs/plugins.md)
  resume   a run folder; takes only train.frames, train.checkpoint_every, eval.*, env.num_threads, import beside it"""

_RESUMABLE = ("train.frames", "train.checkpoint_every", "eval.every", "eval.episodes", "env.num_threads", "import")


def main(arguments: Sequence[str] | None = None) -> int:
    """Train; return the exit status."""
    return run_command(_train, _USAGE, ("config", "resume"), arguments)


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
        announce_compiling()
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
        announce_compiling()
        trainer = new_run(config, name)
        folder = trainer.folder
        print(f"training {config.train.frames:,} steps in {folder}")
    finished = trainer.run()
    minutes = trainer.seconds / 60
    if not finished:
        print(f"stopped after {minutes:.1f} min of training; go on with: python train.py resume={folder}")
        return 130
    baseline = "formation_integral" if trainer.config.control.action == "reference" else "none"
    print(
        f"trained {trainer.frames:,} steps in {minutes:.1f} min: success {trainer.best[0]:.1%}, "
        f"payload error {-100 * trainer.best[1]:.2f} cm (best evaluation during training)\n"
        f"curves:   tensorboard --logdir {folder}\n"
        f"evaluate: python evaluate.py run={folder} episodes=200 seed=1000 baseline={baseline} video=true"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
