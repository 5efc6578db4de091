"""`python -m multilift_marl.px4 config=hover px4=DIR`: PX4 autopilots fly a team in the simulation."""

from __future__ import annotations

import os
import shutil
import sys
import time
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from dataclasses import replace
from functools import partial
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import Field

from multilift_marl._interrupt import ending_at_once, interrupted_by_signals
from multilift_marl.agents.policy import find_policy
from multilift_marl.command import (
    CommandOptions,
    check_needs,
    limit_torch_threads,
    make_out,
    run_command,
    split_options,
    title,
)
from multilift_marl.config.config import Config
from multilift_marl.config.load import choose_config
from multilift_marl.envs.core import MultiliftVec
from multilift_marl.errors import ConfigError, FlightError, warn_once
from multilift_marl.evaluation.metrics import format_table, make_report, write_report
from multilift_marl.schema.values import Between, Float, Int

if TYPE_CHECKING:
    from multilift_marl.deploy.px4.flight import Flight, FlightResult, Maker
    from multilift_marl.deploy.px4.live import LiveTeam
    from multilift_marl.deploy.px4.phases import Phase
    from multilift_marl.deploy.px4.team import AutopilotTeam

_USAGE = """Fly one episode of a task by PX4 autopilots, in lockstep with the simulation: from slack cables on the
ground to the task, back, and down again; then the same task by the controller of this package.

  python -m multilift_marl.px4 config=hover policy=formation_integral px4=~/PX4-Autopilot [key=value ...]

With live=true the flight is on ROS 2 topics, see docs/ros.md; with policy=none others fly the task, by
/drone_<i>/setpoint, or with names=report by set-points of PX4. Everything stays on this machine (127.0.0.1) unless
allow_network=true. Any configuration key changes the environment: env.num_drones=6."""
OURS = "geometric controller"
SLOW_LOOP = 2.5  # [rad/s] of position, up to which a policy may know what drones under PX4 are like


_NEEDS = {
    "domain": "live=true", "sync": "live=true", "allow_network": "live=true", "patience": "policy=none",
    "names": "live=true or bag=<folder>", "ros": "live=true or bag=<folder>",
}  # fmt: skip
"""What keys of the command mean nothing without."""


class Options(CommandOptions):
    """Keys of the command beside those of the configuration."""

    config: str | None = Field(None, description="the task, name or path; None: what a policy was trained in, or hover")
    policy: str = Field(
        "formation_integral",
        description="a baseline, a run, module:Class, .onnx, .pt; none: others' set-points, with live=true",
    )
    px4: str | None = Field(None, description="PX4's folder, with a build of px4_sitl_default; None: PX4_DIR")
    seed: Int = Field(1000, ge=0, description="evaluation seed: the episode is the first of evaluate.py")
    speed: Annotated[Float, Between(0, 100, "-")] = Field(
        0.0, description="largest real-time factor; 0 for as fast as it goes"
    )
    instance: Annotated[Int, Between(0, 9)] = Field(
        0, description="of the first PX4, which makes the ports: 4560, 14540, 14580 + instance"
    )
    timeout: Annotated[Float, Between(0.1, 600, "s")] = Field(
        30.0, description="[s] for a PX4 to connect or to answer, and for others' first set-points"
    )
    parameters: dict[Annotated[str, Field(pattern="^[A-Z][A-Z0-9_]{1,15}$")], Float] = Field(
        {}, description="of PX4, in place of ours: parameters={MPC_XY_P: 1.2}"
    )
    position_errors: Annotated[Float, Between(0, 10, "-")] = Field(
        1.0, description="of the satellite positioning of all drones, in multiples of an RTK receiver's"
    )
    bag: str | None = Field(None, description="folder of a ROS 2 bag of the task, see docs/ros.md")
    live: bool = Field(False, description="whether the whole flight is published on ROS 2 topics, by DDS")
    ros: Literal["humble", "jazzy", "kilted", "lyrical"] = Field("jazzy", description="distribution of bag and peers")
    names: Literal["multilift", "report"] = Field("multilift", description="of the topics: ours or the report's")
    start: Literal["at_once", "topic"] = Field(
        "at_once", description="topic: take-off waits for 2, the task for 5 on all /state/command_drone_<i>"
    )
    sync: bool = Field(True, description="with names=report, whether /sync_time is published; role=clock does, too")
    domain: Annotated[Int, Between(0, 232)] = Field(0, description="ROS_DOMAIN_ID of the peers")
    allow_network: bool = Field(False, description="whether other machines may hear and fly it, by multicast")
    patience: Annotated[Float, Between(0, 1.5, "s")] = Field(
        0.1, description="[s] of real time that a step waits for the set-points of others, with policy=none"
    )
    log: bool = Field(False, description="also the flight logs of PX4, .ulg")
    out: str | None = Field(None, description="folder for metrics.json, plots and logs; None: runs/px4-...")


def main(arguments: Sequence[str] | None = None) -> int:
    """Fly; return the exit status."""
    return run_command(_fly, _USAGE, Options, arguments)


def _fly(values: dict[str, Any]) -> int:
    from multilift_marl.deploy.px4.flight import check_config
    from multilift_marl.deploy.px4.launch import find_px4

    options, overrides = split_options(Options, values)
    check_needs(options, _NEEDS)
    policy = None if options.policy == "none" else find_policy(options.policy, others=["none"])
    if policy is None and not options.live:
        raise ConfigError("with policy=none others fly the team, by topics; set live=true")
    if options.start == "topic" and not options.live:
        raise ConfigError("with start=topic the flight waits for orders by topics; set live=true")
    config = check_config(choose_config(options.config, None if policy is None else policy.config, overrides))
    if policy is not None:
        policy.check(config, "policy")
        _warn_of_loops(options.policy, policy.config)
    elif config.control.action != "reference":
        raise ConfigError(f"set-points of others are for control.action=reference, not {config.control.action}")
    folder = options.px4 or os.environ.get("PX4_DIR")
    if not folder:
        raise ConfigError(
            "no PX4 is given; clone PX4-Autopilot, run `make px4_sitl_default` there, and give px4=<folder> or PX4_DIR"
        )
    build = find_px4(folder)
    if (count := options.instance + config.env.num_drones) > 10:
        raise ConfigError(
            f"instance={options.instance} and {config.env.num_drones} drones need PX4 instances up to {count - 1}, but "
            "PX4's start-up knows 0 to 9; lower one of them"
        )
    if options.bag is not None:
        from multilift_marl.deploy.ros.bag import check_free

        check_free(Path(options.bag))
    limit_torch_threads()
    with ending_at_once():
        vec = MultiliftVec(config)
        if policy is not None:
            policy.bind(vec)  # refuses what does not fit, before anything starts
    name = f"px4-{title({'config': options.config or config.task})}-{Path(options.policy).stem}"
    out = make_out(options.out, Path("runs") / name)

    try:
        return _fly_and_report(config, None if policy is None else policy.bind, options, build, out)
    except BaseException:
        with suppress(OSError):
            out.rmdir()  # if nothing has been written
        raise


def _fly_and_report(config: Config, bind: Maker | None, options: Options, build: Path, out: Path) -> int:
    """Fly by PX4 and by our controller; write and print the results; return 1 if the flight ended before its end.

    `bind` returns the policy for environments; None: others fly the team.
    """
    from multilift_marl.deploy.px4.flight import Flight
    from multilift_marl.deploy.px4.team import AutopilotTeam, Settings
    from multilift_marl.sensing.suite import SensorSuite

    suite = SensorSuite()
    suite = replace(suite, position=suite.position.scaled(options.position_errors))
    begin = time.perf_counter()
    settings = Settings(
        build=build, first=options.instance, timeout=options.timeout, speed=options.speed, seed=options.seed,
        log=options.log, parameters=options.parameters, suite=suite,
    )  # fmt: skip
    with interrupted_by_signals(), AutopilotTeam(config.system, 1 / config.sim.control_hz, settings) as team:
        say = partial(print, flush=True)
        live = _open_live(config, options, team) if options.live else None
        watched = () if live is None else (live.publish, live)
        flight = Flight(config, team, options.seed, say, *watched)
        try:
            result = _record(flight, bind or _others(live), options)
        except FlightError:
            print(describe_phases(flight.phases))
            raise
        finally:
            if options.log:
                _keep_logs(team.autopilots.folder if team.autopilots else None, out)
        factor = team.time / (time.perf_counter() - begin)
    ours = None if bind is None else flight.fly_ours(bind)
    report = make_report(config, options.seed, result.metrics, {} if ours is None else {OURS: ours.metrics})
    report["px4"] = {
        "drone_error_m": None if bind is None else result.drone_error, "estimate_error_m": result.estimate_error,
        "margin_m": flight.margin, "real_time_factor": factor,
        "lockstep_faults": sum(link.faults for link in team.links),
        "phases": [phase._asdict() for phase in result.phases if phase.seconds > 0.0], "ended": result.ended,
    }  # fmt: skip
    if options.speed:
        report["px4"]["lateness_s"] = dict(zip(("50 %", "99 %", "99.9 %"), team.clock.lateness().tolist(), strict=True))
    if live is not None and live.answers is not None:
        report["px4"]["steps_without_setpoint"] = live.answers.late.tolist()
        print(f"steps without a fresh set-point, by drone: {live.answers.late.tolist()}")
    if ours is not None:
        report["baselines"][OURS]["drone_error_m"] = ours.drone_error
    print(f"\n{options.policy} on {config.task}, seed {options.seed}\n\n{format_table(report, 'PX4')}")
    print(describe_errors(result, ours) + f"{factor:.1f} times real time")
    print(describe_phases(result.phases))
    if options.speed:
        late = " / ".join(f"{1e3 * seconds:.2f}" for seconds in team.clock.lateness())
        print(f"steps began late by {late} ms (50 / 99 / 99.9 %)")
    write_report(out / "metrics.json", report)
    _draw(out, {"PX4": result.trace} | ({} if ours is None else {OURS: ours.trace}))
    print(f"wrote {out / 'metrics.json'} and plots beside it")
    if result.ended:
        print(f"the flight ended early: {result.ended}", file=sys.stderr)
    return 1 if result.ended else 0


def _warn_of_loops(name: str, trained: Config | None) -> None:
    """Warn of a learned policy whose drones answered faster in training than PX4's do."""
    if trained is None or trained.control.action != "reference":  # others do not fly by the position loop
        return
    if (trained.control.position_frequency or SLOW_LOOP + 1.0) > SLOW_LOOP:
        warn_once(
            "px4",
            f"policy={name} was trained with drones that follow their references faster than PX4's position loop of "
            "about 2 rad/s; such policies have failed with PX4. Train with control.position_frequency="
            f"{SLOW_LOOP:g} or less and with delays, see docs/flight.md",
        )


def _open_live(config: Config, options: Options, team: AutopilotTeam) -> LiveTeam:
    from multilift_marl.deploy.px4.live import LiveTeam
    from multilift_marl.deploy.ros.bag import DISTRIBUTIONS
    from multilift_marl.deploy.ros.dds import Node, describe_reach

    node = Node(DISTRIBUTIONS[options.ros][0], options.domain, options.allow_network)
    print(f"publishing {describe_reach(options.domain, options.allow_network, options.ros)}", flush=True)
    others, waiting = options.policy == "none", (options.patience, options.timeout)
    return LiveTeam(config, node, options.names, team, others, waiting, options.start == "topic", options.sync)


def _others(live: LiveTeam | None) -> Maker:
    assert live is not None  # others fly by topics
    return live.bind_others


def describe_errors(result: FlightResult, ours: FlightResult | None) -> str:
    """Return, in words, how far drones were from their references, where these are known, and from their estimates."""
    estimates = f"PX4's estimates of their places: {100 * result.estimate_error:.1f} cm; "
    if ours is None:  # others flew, who know their references
        return estimates
    found, compared = 100 * result.drone_error, 100 * ours.drone_error
    return f"drones from their references: {found:.1f} cm, with our controller {compared:.1f} cm (RMS); {estimates}"


def describe_phases(phases: Sequence[Phase]) -> str:
    """Return the extremes of all parts of a flight as a table."""
    lines = [f"{'phase':<20} {'s':>6} {'separation m':>13} {'tension N':>10} {'tilt deg':>9}"]
    for name, seconds, separation, tension, tilt in phases:
        apart = f"{separation:.2f}" if isfinite(separation) else "-"
        lines.append(f"{name:<20} {seconds:>6.1f} {apart:>13} {tension:>10.1f} {tilt:>9.1f}")
    return "\n".join(lines)


def _record(flight: Flight, bind: Maker, options: Options) -> FlightResult:
    """Fly, with a bag of the task if asked."""
    if options.bag is None:
        return flight.fly(bind)
    from multilift_marl.deploy.ros.bag import BagWriter

    bags: list[BagWriter] = []
    with ExitStack() as stack:

        def record(vec: MultiliftVec) -> None:
            if not bags:  # no bag of a flight that does not reach its task
                folder = Path(str(options.bag))
                bags.append(stack.enter_context(BagWriter(folder, vec, options.ros, options.names)))
            else:
                bags[0].write(vec.steps[0] * vec.task.dt)

        result = flight.fly(bind, record)
    print(f"wrote {options.bag}")
    return result


def _keep_logs(folder: Path | None, out: Path) -> None:
    for i, path in enumerate(sorted(folder.glob("*/log/*/*.ulg")) if folder else []):
        shutil.copyfile(path, out / f"px4_{i}.ulg")
        print(f"wrote {out / f'px4_{i}.ulg'}")


def _draw(out: Path, traces: dict[str, Any]) -> None:
    from multilift_marl.evaluation import plots

    plots.plot_errors(out / "errors.png", traces)
    plots.plot_tensions(out / "tensions.png", traces["PX4"], "PX4")
    plots.plot_paths(out / "paths.png", traces["PX4"], "PX4")


if __name__ == "__main__":
    sys.exit(main())
