"""`python -m multilift_marl.view task=hover run=hover`: watch a team in the browser."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from contextlib import closing, suppress
from typing import Any

from pydantic import Field

from multilift_marl._interrupt import Watch, ending_at_once, leave
from multilift_marl.agents.policy import NamedPolicy, find_policy, load_policy
from multilift_marl.command import check_needs, run_command, split_options
from multilift_marl.config.config import Config
from multilift_marl.config.load import build_config, load_config, load_rig
from multilift_marl.deploy.sitl.view import ViewOptions
from multilift_marl.errors import ConfigError
from multilift_marl.schema.values import Int
from multilift_marl.tasks import list_tasks
from multilift_marl.viewer.draft import DraftSession
from multilift_marl.viewer.live import LiveSession
from multilift_marl.viewer.page import HOST, Page
from multilift_marl.viewer.session import Session

_USAGE = f"""Watch a team in the browser, at an address of this machine alone ({HOST}).

  python -m multilift_marl.view task=hover run=hover [key=value ...]
  python -m multilift_marl.view live=true domain=7       # what others fly and publish on ROS 2 topics

Any configuration key changes the environment: env.num_drones=6, payload.mass=1.7, cable.model=chain.
A rig that is refused is shown at rest, what conflicts in red."""

_NICE = 10  # of a live view: the flight on this machine goes first


class Options(ViewOptions):
    """Keys of the command beside those of the configuration."""

    task: str | None = Field(None, description="a configuration's name or path; None: the run's own, or hover")
    run: str | None = Field(None, description='a run folder, "latest", or a shipped policy ("hover"); None: baselines')
    seed: Int = Field(1000, ge=0, lt=2**63, description="evaluation seed: the episodes are those of evaluate.py")


def main(arguments: Sequence[str] | None = None) -> int:
    """Serve until interrupted; return the exit status."""
    return run_command(_view, _USAGE, Options, arguments, configuration="task")


def _view(values: dict[str, Any]) -> int:
    print("starting the viewer, which takes some seconds", flush=True)
    if values.get("live") is True and hasattr(os, "nice"):
        os.nice(_NICE)  # before there are threads, which have it from this one
    with ending_at_once():
        session, port = make_session(values)
        page = Page(session, port)
    refused = isinstance(session, DraftSession)
    if isinstance(session, DraftSession):
        print(f"error: {session.reason}", file=sys.stderr, flush=True)
    print(f"{'see what conflicts' if refused else 'watch'} at {page.address} (Ctrl-C ends it)", flush=True)
    if isinstance(session, LiveSession):
        with Watch(lambda number: leave(0)):  # nothing is lost, and a busy machine takes seconds to end page and DDS
            page.run()
    with closing(page), suppress(KeyboardInterrupt):
        page.run()
    return 2 if refused else 0


def make_session(values: dict[str, Any]) -> tuple[Session | LiveSession | DraftSession, int]:
    """Return the session and the port of key=value arguments; of a rig that is refused one that only shows it.

    Raises:
        ConfigError, CheckpointError: a wrong value, or there is no such task, run or policy.
        FlightError: a flight cannot be heard, as DDS does not start.
    """
    options, overrides = split_options(Options, values)
    check_needs(options, dict.fromkeys(("allow_network", "domain", "names", "ros"), "live=true"))
    named: dict[str, NamedPolicy] = {}
    if options.run is not None:
        named["run"] = load_policy(options.run)
    policy = "run" if named and options.policy is None else options.policy
    if policy is not None and policy != "run":
        named[policy] = find_policy(policy, others=named)
    config = _find_config(options, named, {**overrides, "env.num_envs": 1, "env.num_threads": 1})
    if options.live:
        return _listen(options, config), options.port
    try:
        _ = config.system
    except ConfigError:
        return DraftSession(config), options.port
    return Session(config, named, policy, options.seed), options.port


def _listen(options: Options, config: Config) -> LiveSession:
    """Return a session that shows what is heard."""
    from multilift_marl.deploy.ros.bag import DISTRIBUTIONS
    from multilift_marl.deploy.ros.dds import Node, describe_reach

    node = Node(DISTRIBUTIONS[options.ros][0], options.domain, options.allow_network)
    print(f"listening {describe_reach(options.domain, options.allow_network, options.ros)}", flush=True)
    return LiveSession(config, node, options.names)


def _find_config(options: Options, named: dict[str, NamedPolicy], overrides: dict[str, Any]) -> Config:
    task = options.task
    if options.config is not None:
        if task is not None and task not in list_tasks():  # of a configuration, which brings its task
            return load_rig(options.config, task, overrides)
        return load_config(options.config, overrides if task is None else {**overrides, "task": task})
    trained = [policy.config for policy in named.values() if policy.config is not None]
    if task is None and trained:
        return build_config(trained[0].model_dump(), overrides)
    return load_config("hover" if task is None else task, overrides)


if __name__ == "__main__":
    sys.exit(main())
