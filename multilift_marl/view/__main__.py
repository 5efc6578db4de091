"""`python -m multilift_marl.view task=hover run=hover`: watch a team in the browser."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from contextlib import closing, suppress
from typing import Any

from multilift_marl.cli.common import run_command, whole_number
from multilift_marl.cli.policies import NamedPolicy, find_policy
from multilift_marl.config.config import Config
from multilift_marl.config.load import build_config, load_config
from multilift_marl.control.scripted import SCRIPTED
from multilift_marl.view.page import HOST, Page
from multilift_marl.view.session import Session

_USAGE = f"""Watch a team in the browser, at an address of this machine alone ({HOST}).

  python -m multilift_marl.view task=hover run=hover [key=value ...]

  task    a configuration's name or path                      (the run's own, or hover)
  config  a rig or other configuration for that task; its vehicles, payload, cables and control are used, see
          python train.py --help
  run     a run folder, "latest", or the name of a shipped policy ("hover"); none: scripts only
  policy  which controls first: run, a script, module:Class, an exported policy (.onnx), a checkpoint (.pt)
                                                              (run, or formation)
  import  a module of yours with tasks or vehicles (docs/plugins.md)
  seed    evaluation seed: the episodes are those of evaluate.py        (1000)
  port    of the address; 0 for any free one                  (8080)

Any configuration key changes the environment: env.num_drones=6, payload.mass=1.7, cable.model=chain."""

_DEFAULTS = {"task": None, "config": None, "run": None, "policy": None, "seed": 1000, "port": 8080}


def main(arguments: Sequence[str] | None = None) -> int:
    """Serve until interrupted; return the exit status."""
    return run_command(
        _view, _USAGE, _DEFAULTS, arguments, configuration="task", names=("task", "config", "run", "policy")
    )


def _view(values: dict[str, Any]) -> int:
    print("starting the viewer, which takes some seconds", flush=True)
    page = Page(*make_session(values))
    print(f"watch at {page.address} (Ctrl-C ends it)", flush=True)
    with closing(page), suppress(KeyboardInterrupt):
        page.run()
    return 0


def make_session(values: dict[str, Any]) -> tuple[Session, int]:
    """Return the session and the port of key=value arguments.

    Raises:
        ConfigError, CheckpointError: a wrong value, or there is no such task, run or policy.
    """
    own = {key: values.pop(key, default) for key, default in _DEFAULTS.items()}
    for key, most in (("seed", 2**63 - 1), ("port", 65535)):
        own[key] = whole_number(key, own[key], 0, most)
    learned: dict[str, NamedPolicy] = {}
    if own["run"] is not None:
        learned["run"] = _load(str(own["run"]))
    policy = str(own["policy"]) if own["policy"] is not None else "run" if learned else None
    if policy is not None and policy not in ("run", *SCRIPTED):
        learned[policy] = find_policy(policy, others=learned)
    config = _find_config(own, learned, {**values, "env.num_envs": 1, "env.num_threads": 1})
    return Session(config, learned, policy, own["seed"]), own["port"]


def _find_config(own: dict[str, Any], learned: dict[str, NamedPolicy], overrides: dict[str, Any]) -> Config:
    task = own["task"]
    config = own["config"]
    if config is not None:
        return load_config(str(config), overrides if task is None else {**overrides, "task": task})
    trained = [policy.config for policy in learned.values() if policy.config is not None]
    if task is None and trained:
        return build_config(trained[0].model_dump(), overrides)
    return load_config("hover" if task is None else str(task), overrides)


def _load(run: str) -> Any:
    from multilift_marl.agents.checkpoint import find_run
    from multilift_marl.agents.policy import load_policy, shipped_policies

    return load_policy(run if run in shipped_policies() else find_run(run))


if __name__ == "__main__":
    sys.exit(main())
