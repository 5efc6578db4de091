"""`python -m multilift_marl.view task=hover run=hover`: watch a team in the browser."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from contextlib import closing, suppress
from typing import Annotated, Any

from pydantic import Field

from multilift_marl._interrupt import ending_at_once
from multilift_marl.agents.policy import NamedPolicy, find_policy, load_policy
from multilift_marl.command import CommandOptions, run_command, split_options
from multilift_marl.config.config import Config
from multilift_marl.config.load import build_config, load_config
from multilift_marl.errors import ConfigError
from multilift_marl.policies.baselines import SCRIPTED
from multilift_marl.schema.values import Between, Int
from multilift_marl.viewer.draft import DraftSession
from multilift_marl.viewer.page import HOST, Page
from multilift_marl.viewer.session import Session

_USAGE = f"""Watch a team in the browser, at an address of this machine alone ({HOST}).

  python -m multilift_marl.view task=hover run=hover [key=value ...]

Any configuration key changes the environment: env.num_drones=6, payload.mass=1.7, cable.model=chain.
A rig that is refused is shown at rest, what conflicts in red."""


class Options(CommandOptions):
    """Keys of the command beside those of the configuration."""

    task: str | None = Field(None, description="a configuration's name or path; None: the run's own, or hover")
    config: str | None = Field(
        None, description="a rig or other configuration for that task, see python train.py --help"
    )
    run: str | None = Field(None, description='a run folder, "latest", or a shipped policy ("hover"); None: baselines')
    policy: str | None = Field(
        None, description="the first: run, a baseline, module:Class, .onnx, .pt; None: run, or formation"
    )
    seed: Int = Field(1000, ge=0, lt=2**63, description="evaluation seed: the episodes are those of evaluate.py")
    port: Annotated[Int, Between(0, 65535)] = Field(8080, description="of the address; 0 for any free one")


def main(arguments: Sequence[str] | None = None) -> int:
    """Serve until interrupted; return the exit status."""
    return run_command(_view, _USAGE, Options, arguments, configuration="task")


def _view(values: dict[str, Any]) -> int:
    print("starting the viewer, which takes some seconds", flush=True)
    with ending_at_once():
        session, port = make_session(values)
        page = Page(session, port)
    refused = isinstance(session, DraftSession)
    if isinstance(session, DraftSession):
        print(f"error: {session.reason}", file=sys.stderr, flush=True)
    print(f"{'see what conflicts' if refused else 'watch'} at {page.address} (Ctrl-C ends it)", flush=True)
    with closing(page), suppress(KeyboardInterrupt):
        page.run()
    return 2 if refused else 0


def make_session(values: dict[str, Any]) -> tuple[Session | DraftSession, int]:
    """Return the session and the port of key=value arguments; of a rig that is refused one that only shows it.

    Raises:
        ConfigError, CheckpointError: a wrong value, or there is no such task, run or policy.
    """
    options, overrides = split_options(Options, values)
    learned: dict[str, NamedPolicy] = {}
    if options.run is not None:
        learned["run"] = load_policy(options.run)
    policy = "run" if learned and options.policy is None else options.policy
    if policy is not None and policy not in ("run", *SCRIPTED):
        learned[policy] = find_policy(policy, others=learned)
    config = _find_config(options, learned, {**overrides, "env.num_envs": 1, "env.num_threads": 1})
    try:
        _ = config.system
    except ConfigError:
        return DraftSession(config), options.port
    return Session(config, learned, policy, options.seed), options.port


def _find_config(options: Options, learned: dict[str, NamedPolicy], overrides: dict[str, Any]) -> Config:
    task = options.task
    if options.config is not None:
        return load_config(options.config, overrides if task is None else {**overrides, "task": task})
    trained = [policy.config for policy in learned.values() if policy.config is not None]
    if task is None and trained:
        return build_config(trained[0].model_dump(), overrides)
    return load_config("hover" if task is None else task, overrides)


if __name__ == "__main__":
    sys.exit(main())
