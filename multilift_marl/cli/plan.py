"""`python -m multilift_marl.plan waypoints=gates.csv out=path.csv`, installed as `multilift-plan`."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import Annotated, Any

from pydantic import AfterValidator, Field

from multilift_marl._files import write_whole
from multilift_marl._interrupt import ending_at_once
from multilift_marl.command import CommandOptions, make_folder, run_command, split_options
from multilift_marl.config.load import load_config
from multilift_marl.errors import ConfigError
from multilift_marl.planning.feasibility import Feasibility, assess_path
from multilift_marl.planning.path_file import PathFile, load_path
from multilift_marl.planning.path_table import COLUMNS
from multilift_marl.planning.team_model import has_model
from multilift_marl.planning.waypoints import Keys, describe_violation, plan_waypoints, sample_rows
from multilift_marl.schema.files import pin_text
from multilift_marl.schema.validate import validate
from multilift_marl.schema.values import Between, Float, Places
from multilift_marl.tasks.track import TrackOptions

_USAGE = """Plan a path through way-points, and say how far its team is from its limits (docs/track.md).

  python -m multilift_marl.plan waypoints="[[0, 0, 1.5], [3, 1, 2, 0.5]]" speed=2 acceleration=2 out=path.csv
  python -m multilift_marl.plan waypoints=gates.csv plot=path.png [key=value ...]
  python -m multilift_marl.plan file=path.csv

Configuration keys change the team: config=track_auto6, env.num_drones=6, payload.mass=1.7."""
_WHOLE = 1e9  # [s] of an episode, of which no path is cut off


class Options(CommandOptions):
    """Keys of the command beside those of the configuration."""

    config: str = Field("track", description="the team that is to fly: name or path of a configuration of task track")
    waypoints: Annotated[Places, AfterValidator(pin_text)] = Field(
        None, description="list of [x, y, z] or [x, y, z, yaw], or a CSV file of such columns"
    )
    times: tuple[Float, ...] | None = Field(
        None, description="[s] at which they are passed, from the first; None: the least"
    )
    speed: Annotated[Float, Between(1e-3, 100, "m/s")] = Field(1.0, description="[m/s] largest, without times")
    acceleration: Annotated[Float, Between(1e-3, 1000, "m/s²")] = Field(
        0.5, description="[m/s²] largest, without times"
    )
    file: Annotated[str | None, AfterValidator(pin_text)] = Field(
        None, description="in place of way-points: a path to assess, see task_options.file"
    )
    out: str | None = Field(None, description="CSV file for task_options.file, of columns t, x, y, z, yaw")
    plot: str | None = Field(None, description="PNG of place, speed, and of tensions and thrusts beside their limits")


def main(arguments: Sequence[str] | None = None) -> int:
    """Plan; return the exit status."""
    with ending_at_once() if arguments is None else nullcontext():
        return run_command(_plan, _USAGE, Options, arguments)


def _plan(values: dict[str, Any]) -> int:
    options, overrides = split_options(Options, values)
    if (options.waypoints is None) == (options.file is None):
        raise ConfigError("give either waypoints=<list or CSV file> or file=<path>")
    _check_keys(options, overrides)
    own: dict[str, Any] = {"path": "file", "file": options.file}
    if options.waypoints is not None:
        own = {"path": "waypoints", "waypoints": options.waypoints, "waypoint_times": options.times}
        own |= {"speed": options.speed, "acceleration": options.acceleration}
    config = load_config(options.config, overrides | {f"task_options.{key}": value for key, value in own.items()})
    if config.task != "track":
        raise ConfigError(f"config={options.config} is of task {config.task}; give one of task track")
    if config.scene.obstacles:
        raise ConfigError(
            "plans know no obstacles, and would lead through scene.obstacles; leave them out, or search a route: "
            "config=navigate policy=mpc_route"
        )
    system, ranges = config.system, config.randomization
    if not has_model(system):
        raise ConfigError(
            "plans are assessed for bodies with two anchors or more, apart, and for points; set payload.shape=point, "
            "or take another rig"
        )
    option = validate(TrackOptions, config.task_options, "task_options")
    refusal = ""
    if option.waypoints is None:
        file = PathFile(str(option.file), option.file_spacing, option.file_ramp, option.file_offset)
        table = load_path(file, _WHOLE, system, ranges, "file")
        feasibility = assess_path(table, system, ranges)
    else:
        limits = option.speed, option.acceleration
        path = plan_waypoints(option.waypoints, option.waypoint_times, *limits, system, Keys("waypoints", "times"))
        table, feasibility = path.table, assess_path(path.table, system, ranges)
        for key in {"speed", "acceleration"} & options.model_fields_set if path.timed else ():
            raise ConfigError(f"{key} means nothing beside times, which {path.name} has; leave out one of them")
        print("way-points at " + ", ".join(f"{time:.2f}" for time in path.times) + " s")
        if feasibility.violation is not None:
            refusal = describe_violation(path, feasibility.violation, "")
    print(f"{table[-1, 0]:.2f} s, {system.num_drones} drones\n\n{_format(feasibility)}")
    if options.plot is not None:
        from multilift_marl.evaluation.plots import plot_plan

        plot_plan(_place("plot", options.plot), table, feasibility)
        print(f"wrote {options.plot}")
    if refusal:
        raise ConfigError(refusal)
    if options.out is not None:
        lines = [",".join(COLUMNS), *(",".join(f"{number:.9g}" for number in row) for row in sample_rows(table))]
        write_whole(_place("out", options.out), ("\n".join(lines) + "\n").encode())
        print(f"wrote {options.out}; fly it by task_options.path=file task_options.file={options.out}")
    return 0


def _check_keys(options: Options, overrides: dict[str, Any]) -> None:
    """Refuse, by a ConfigError, keys that mean nothing beside others, and names of files of other kinds."""
    for key in ("path", "file", "waypoints", "waypoint_times", "speed", "acceleration"):
        if f"task_options.{key}" in overrides:
            own = {"path": "waypoints or file", "waypoint_times": "times"}.get(key, key)
            raise ConfigError(f"task_options.{key} means nothing to this command; set {own}")
    for key in ("times", "speed", "acceleration"):
        if key in options.model_fields_set and options.file is not None:
            raise ConfigError(f"{key} means nothing beside file, a path with its own times; leave out one of them")
    for key, ending in (("out", ".csv"), ("plot", ".png")):
        name = getattr(options, key)
        if name is not None and not name.lower().endswith(ending):
            raise ConfigError(f"{key}={name} is written as {ending[1:].upper()}; give a name that ends in {ending}")


def _format(feasibility: Feasibility) -> str:
    """Return a table with a line for each limit: where the path is nearest to it."""
    lines = [f"{'least spare of':<15}{'':>10}  of {'drone':<8}{'at':>9}{'value':>10}{'limit':>10}"]
    for margin in feasibility.margins:
        who = "payload" if margin.drone < 0 else margin.drone
        numbers = f"{margin.time:>7.2f} s{margin.value:>10.3g}{margin.limit:>10.3g}"
        lines.append(f"{margin.quantity:<15}{margin.spare:>6.3g} {margin.unit:<3}     {who!s:<8}{numbers}")
    return "\n".join(lines)


def _place(key: str, name: str) -> Path:
    """Return where the file of a key is to be written; its folder is made."""
    path = Path(name).expanduser()
    return make_folder(path.parent, f"{key}=<path>") / path.name
