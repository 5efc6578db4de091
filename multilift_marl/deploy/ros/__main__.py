"""`python -m multilift_marl.ros policy=hover`: a live simulation on ROS 2 topics, or a node that flies one."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterable, Sequence
from contextlib import suppress
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from pydantic import Field

from multilift_marl._interrupt import ending_at_once, interrupted_by_signals
from multilift_marl.agents.policy import NamedPolicy, find_policy
from multilift_marl.command import CommandOptions, limit_torch_threads, run_command, split_options
from multilift_marl.config.config import Config
from multilift_marl.config.load import choose_config
from multilift_marl.envs.core import EVALUATION, MultiliftVec
from multilift_marl.errors import ConfigError
from multilift_marl.policies.mpc import ENOUGH
from multilift_marl.realtime import QUANTILES, RealTime
from multilift_marl.schema.values import Between, Float, Int

if TYPE_CHECKING:
    from multilift_marl.deploy.ros.dds import Node

_USAGE = """Simulate a team live on ROS 2 topics, by DDS, without ROS 2: docs/ros.md lists the topics.

  python -m multilift_marl.ros config=hover policy=formation [key=value ...]
  python -m multilift_marl.ros config=hover policy=none      # others fly it, by /drone_<i>/setpoint
  python -m multilift_marl.ros role=policy policy=hover.onnx # from odometry to set-points, of what flies elsewhere
  python -m multilift_marl.ros role=trajectory_planner config=track  # or mpc_planner
  python -m multilift_marl.ros role=geometric_control         # from set-points to attitudes
  python -m multilift_marl.ros role=clock

Only this machine hears it (interface lo, no multicast), unless allow_network=true. Any configuration key changes the
environment: env.num_drones=6."""


FLYING = ("policy", "trajectory_planner", "mpc_planner")
NODES = (*FLYING, "geometric_control", "clock")
OF_ROLES: dict[str, tuple[str, ...]] = {
    "policy": ("simulation", *FLYING), "speed": ("simulation",), "sync": ("simulation",), "start": FLYING,
    "receiver": FLYING, "output": ("geometric_control",), "drones": ("geometric_control",),
    "patience": ("geometric_control", "clock"),
}  # fmt: skip
"""Roles to which a key of the command means something, where it does not to all."""
CLOCK_PATIENCE = 5.0  # [s]
OURS = ("simulation", "policy")  # whose topics are ours unless they are told otherwise
USUAL: dict[str, dict[str, Any]] = {
    "mpc_planner": {"control.action": "full_state", "planner.feedback": 0.0, "planner.estimate": False}
    | {f"control.{key}": wide for key, (_, wide) in ENOUGH["full_state"].items()},
    # PX4's attitude loop answers at 6.5 rad/s, so that the position loop is as slow as PX4's own, see conditions/px4.
    "geometric_control": {
        "control.position_frequency": 2.12, "control.position_damping": 0.707, "control.disturbance": "integral",
        "control.disturbance_frequency": 0.65, "control.attitude_frequency": 11.0,
    },
}  # fmt: skip
"""Values of the configuration that a role has unless it is told otherwise: the whole motion; PX4's loops."""


class Options(CommandOptions):
    """Keys of the command beside those of the configuration."""

    config: str | None = Field(None, description="the task, name or path; None: the policy's own, or hover")
    role: Literal["simulation", *NODES] = Field(  # type: ignore[valid-type]
        "simulation", description="what this is: a team in simulation, or a node of a pipeline that flies one elsewhere"
    )
    policy: str | None = Field(
        None,
        description="a baseline, a run, module:Class, .onnx, .pt; none: others' set-points; "
        "None: formation, of role=mpc_planner mpc",
    )
    receiver: Literal["px4", "geometric_control"] = Field(
        "px4", description="of a planner's set-points with names=report: PX4 itself, or a geometric-control node"
    )
    output: Literal["attitude", "rates"] = Field(
        "attitude", description="of geometric control, with thrust: attitudes, or body rates"
    )
    drones: list[Int] | None = Field(None, description="with role=geometric_control: which it controls; None: all")
    patience: Annotated[Float, Between(0, 600, "s")] | None = Field(
        None,
        description="[s] of real time that geometric control waits for the set-point of an odometry, and a clock "
        "for /clock before it broadcasts the machine's time; None: 0, of the clock 5",
    )
    sync: bool = Field(True, description="with names=report, whether a simulation publishes /sync_time, as clocks do")
    start: Literal["at_once", "topic", "stage"] | None = Field(
        None,
        description="when a policy begins: as soon as all is heard, when true comes on /fly, or in stage 5 of "
        "/state/state_drone_<i>; None: at_once, of planners stage",
    )
    seed: Int = Field(1000, ge=0, description="evaluation seed: the episodes are those of evaluate.py")
    speed: Annotated[Float, Between(0, 100, "-")] = Field(1.0, description="real-time factor; 0: as fast as it goes")
    seconds: Annotated[Float, Between(0, 1e9, "s")] = Field(
        0.0, description="[s] of the simulation, of a policy by the clock; 0: until Ctrl-C"
    )
    ros: Literal["humble", "jazzy", "kilted", "lyrical"] = Field("jazzy", description="distribution of the peers")
    names: Literal["multilift", "report", "crazyswarm2"] | None = Field(
        None,
        description="of the topics: ours, the report's or Crazyswarm2's; None: ours, of planners, control and clock "
        "the report's",
    )
    domain: Annotated[Int, Between(0, 232)] = Field(0, description="ROS_DOMAIN_ID of the peers")
    allow_network: bool = Field(False, description="whether other machines may hear and fly it, by multicast")


def check_role(role: str, keys: Iterable[str]) -> None:
    """Refuse, by a ConfigError, keys that mean nothing to a role."""
    for key in keys:
        if role not in (roles := OF_ROLES.get(key, (role,))):
            raise ConfigError(f"{key} means nothing to role={role}, but to {', '.join(roles)}; leave it out")


def main(arguments: Sequence[str] | None = None) -> int:
    """Simulate or fly until interrupted; return the exit status."""
    return run_command(_run, _USAGE, Options, arguments)


def _run(values: dict[str, Any]) -> int:
    from multilift_marl.deploy.ros.bag import DISTRIBUTIONS
    from multilift_marl.deploy.ros.dds import Node, describe_reach

    options, overrides = split_options(Options, values)
    check_role(options.role, sorted(options.model_fields_set))
    if options.names is None:
        options = options.model_copy(update={"names": "multilift" if options.role in OURS else "report"})
    overrides = USUAL.get(options.role, {}) | overrides
    name = options.policy or ("mpc" if options.role == "mpc_planner" else "formation")
    policy = None if name == "none" else find_policy(name, others=["none"])
    overrides |= {"env.num_envs": 1, "env.num_threads": 1}
    config = choose_config(options.config, None if policy is None else policy.config, overrides)
    if policy is not None and options.role in ("simulation", *FLYING):
        policy.check(config, "policy")
    limit_torch_threads()
    node = Node(DISTRIBUTIONS[options.ros][0], options.domain, options.allow_network)
    ending = f"{describe_reach(options.domain, options.allow_network, options.ros)} (Ctrl-C ends it)"
    with interrupted_by_signals():
        if options.role in FLYING:
            _fly(options, config, policy, node, ending)
        elif options.role == "geometric_control":
            _control(options, config, node, ending)
        elif options.role == "clock":
            _broadcast(options, config, node, ending)
        else:
            _simulate(options, config, policy, node, ending)
    return 0


def _simulate(options: Options, config: Config, policy: NamedPolicy | None, node: Node, ending: str) -> None:
    """Simulate a team, flown by a policy, or by others where there is none."""
    from multilift_marl.deploy.ros.live import LiveFlight

    with ending_at_once():
        vec = MultiliftVec(config, EVALUATION)
    flight = LiveFlight(vec, node, str(options.names), None if policy is None else policy.bind(vec), options.sync)
    clock, begin = RealTime(options.speed), time.perf_counter()
    flight.begin(options.seed)
    print(f"publishing {ending}", flush=True)
    with suppress(KeyboardInterrupt):
        while not options.seconds or flight.time_ns < options.seconds * 1e9:
            flight.step()
            clock.wait(flight.time_ns * 1e-9)
    simulated, real = flight.time_ns * 1e-9, time.perf_counter() - begin
    print(f"simulated {simulated:.1f} s in {real:.1f} s")
    if options.speed:
        print(f"steps began late by {_describe(clock.lateness())}, {clock.slips} too late to catch up")
    if flight.answers is not None:
        print(f"steps without a fresh set-point, by drone: {flight.answers.late.tolist()}")
    _report_left_out(node)


def _fly(options: Options, config: Config, policy: NamedPolicy | None, node: Node, ending: str) -> None:
    """Fly a team that others measure."""
    from multilift_marl.deploy.ros.policy_node import PolicyNode

    if policy is None:
        raise ConfigError(f"role={options.role} needs a policy: give policy=<a run, an .onnx file or a baseline>")
    staged = options.names == "report"  # others have no stages
    if options.start == "stage" and not staged:
        raise ConfigError(f"start=stage needs the stages of names=report, which names={options.names} does not have")
    start = options.start or ("at_once" if options.role in OURS else "stage" if staged else "topic")
    say = partial(print, flush=True)
    flown = PolicyNode(config, policy.bind, node, str(options.names), options.seed, start, say, options.receiver)
    print(f"listening {ending}", flush=True)
    try:
        flown.spin(options.seconds or float("inf"))
    except KeyboardInterrupt:
        flown.land("interrupted; once more ends this at once")
        with suppress(KeyboardInterrupt):
            while not flown.landed:
                flown.spin_once(1.0)
    print(f"flew {flown.steps} steps")
    if flown.latency:
        print(f"set-points followed odometry by {_describe(np.percentile(flown.latency, QUANTILES))}")
    _report_left_out(node)


def _control(options: Options, config: Config, node: Node, ending: str) -> None:
    """Control drones that others measure and plan for, by attitude and thrust."""
    from multilift_marl.deploy.ros.geometric_node import GeometricControlNode

    say = partial(print, flush=True)
    by_rates = options.output == "rates"
    control = GeometricControlNode(
        config, node, str(options.names), options.drones, options.patience or 0.0, by_rates, say
    )
    print(f"listening {ending}", flush=True)
    with suppress(KeyboardInterrupt):
        control.spin(options.seconds or float("inf"))
    print(f"answered {control.steps} times")
    if control.latency:
        print(f"attitudes followed odometry by {_describe(np.percentile(control.latency, QUANTILES))}")
    _report_left_out(node)


def _broadcast(options: Options, config: Config, node: Node, ending: str) -> None:
    """Broadcast the time."""
    from multilift_marl.deploy.ros.clock_node import ClockNode

    clock = ClockNode(
        config.env.num_drones,
        node,
        CLOCK_PATIENCE if options.patience is None else options.patience,
        say=partial(print, flush=True),
    )
    print(f"broadcasting {ending}", flush=True)
    with suppress(KeyboardInterrupt):
        clock.spin(options.seconds or float("inf"))
    offsets = ", ".join("not heard" if np.isnan(each) else f"{1e3 * each:.1f} ms" for each in clock.offsets())
    print(f"broadcast {clock.sent} times; odometry was stamped beside that, by drone: {offsets}")
    _report_left_out(node)


def _report_left_out(node: Node) -> None:
    """Say how many messages could not be read, where any could not."""
    if left_out := node.reader.left_out:
        counts = ", ".join(f"{count} on {name}" for name, count in sorted(left_out.items()))
        print(f"messages that could not be read: {counts}")


def _describe(late: np.ndarray) -> str:
    """Return quantiles of a time [s] in words."""
    return " / ".join(f"{1e3 * seconds:.2f}" for seconds in late) + " ms (50 / 99 / 99.9 %)"


if __name__ == "__main__":
    sys.exit(main())
