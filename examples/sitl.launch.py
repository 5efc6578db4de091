"""A pipeline of `python -m multilift_marl.sitl` as processes of ROS 2's launch, which ends all when the flight ends.

Run: ros2 launch examples/sitl.launch.py file:=examples/sitl.yaml px4:=PX4-Autopilot arguments:="common.domain=0"
"""

import shlex

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, ExecuteProcess, OpaqueFunction, Shutdown
from launch.substitutions import LaunchConfiguration

from multilift_marl.command import parse_arguments
from multilift_marl.deploy.sitl.pipeline import Options, prepare_commands


def start_processes(context):
    """Return the actions that start all processes, with the arguments of this launch."""
    file, px4, arguments = (LaunchConfiguration(name).perform(context) for name in ("file", "px4", "arguments"))
    commands, out = prepare_commands(parse_arguments(Options, [f"file={file}", *shlex.split(arguments)]))
    environment = {"PYTHONUNBUFFERED": "1"} | ({"PX4_DIR": px4} if px4 else {})
    first = next(iter(commands))  # the flight, or the simulation in its place
    return [
        ExecuteProcess(
            cmd=command, name=name, output="screen", additional_env=environment, sigterm_timeout="10",
            on_exit=Shutdown(reason=f"{name} has ended, whose files are in {out}") if name == first else None,
        )
        for name, command in commands.items()
    ]  # fmt: skip


def generate_launch_description():
    """Return what `ros2 launch` runs."""
    return LaunchDescription(
        [
            DeclareLaunchArgument("file", default_value="examples/sitl.yaml", description="YAML file of the pipeline"),
            DeclareLaunchArgument("px4", default_value="", description="PX4's folder; empty: PX4_DIR"),
            DeclareLaunchArgument("arguments", default_value="", description="key=value over those of the file"),
            OpaqueFunction(function=start_processes),
        ]
    )
