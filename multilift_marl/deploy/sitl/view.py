"""The browser view of a flight, as a process of a pipeline: its keys, and those that it has of the flight's."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Annotated, Any, Literal

from pydantic import Field

from multilift_marl.command import CommandOptions
from multilift_marl.policies.baselines import SCRIPTED
from multilift_marl.schema.values import Between, Int


class ViewOptions(CommandOptions):
    """Keys of `python -m multilift_marl.view` for a live flight, beside those of the configuration."""

    config: str | None = Field(
        None, description="a rig or other configuration for that task, see python train.py --help"
    )
    policy: str | None = Field(
        None, description="the first: run, a baseline, module:Class, .onnx, .pt; None: run, or formation"
    )
    port: Annotated[Int, Between(0, 65535)] = Field(8080, description="of the address; 0 for any free one")
    live: bool = Field(
        False, description="whether a flight on ROS 2 topics is shown, of that configuration or a policy's"
    )
    names: Literal["multilift", "report", "crazyswarm2"] = Field("multilift", description="of a live flight's topics")
    ros: Literal["humble", "jazzy", "kilted", "lyrical"] = Field("jazzy", description="of a live flight: distribution")
    domain: Annotated[Int, Between(0, 232)] = Field(0, description="of a live flight: ROS_DOMAIN_ID")
    allow_network: bool = Field(False, description="whether a live flight may be heard of other machines, by multicast")


def of_flight(values: Mapping[str, Any], options: Collection[str]) -> dict[str, Any]:
    """Return what a view has of a flight's values by dotted name: its rig, and where its topics are.

    Args:
        values: of the flight or simulation.
        options: keys of its command beside those of the configuration.
    """
    untrained = values.get("policy") in (None, "none", *SCRIPTED)  # then the rig is that of the configuration
    return {
        key: value
        for key, value in values.items()
        if value is not None and (key in ViewOptions.model_fields or key not in options)
        if key != "policy" or not untrained
    }
