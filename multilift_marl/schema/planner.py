"""Parameters of the model-predictive planner (`policy=mpc`): its horizon, what it weighs, its limits."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from multilift_marl.schema.values import Between, Float, Int, Section


class PlannerConfig(Section):
    """The planner looks `steps` times `step` ahead; a deviation as large as its tolerance costs 1/2 in each second."""

    steps: Int = Field(20, ge=5, le=200, description="of the horizon")
    step: Annotated[Float, Between(0.005, 0.5, "s")] = Field(0.05, description="[s] length of each")
    limits: Literal["soft", "hard"] = Field(
        "soft", description="soft: exceeding one costs; hard: plans converge within them, see docs/planning.md"
    )
    iterations: Int | None = Field(
        None, ge=1, le=1000, description="in each policy step, with hard limits at most; None: 1, with hard limits 40"
    )
    sweeps: Int = Field(
        3, ge=1, le=100, description="in each policy step of drones of mpc_distributed, but with sensors on board one"
    )
    distributed: bool = Field(
        False, description="whether with control.action=planner_weights each drone plans for itself, as mpc_distributed"
    )
    position: Annotated[Float, Between(1e-4, 100, "m")] = Field(0.02, description="[m] tolerance of the payload")
    attitude: Annotated[Float, Between(0.01, 1000, "deg")] = Field(5.0, description="[deg] of the payload")
    cable: Annotated[Float, Between(0.01, 1000, "deg")] = Field(8.6, description="[deg] of each cable's direction")
    velocity: Annotated[Float, Between(1e-3, 1000, "m/s")] = Field(0.3, description="[m/s] of the payload")
    body_rates: Annotated[Float, Between(1e-3, 1000, "rad/s")] = Field(1.0, description="[rad/s] of the payload")
    cable_rates: Annotated[Float, Between(1e-3, 1000, "rad/s")] = Field(1.0, description="[rad/s] of each cable")
    thrust: Annotated[Float, Between(1e-4, 100)] = Field(
        0.25, description="[-] of each thrust vector, over the thrust at rest"
    )
    thrust_rate: Annotated[Float, Between(1e-3, 1000, "1/s")] = Field(
        3.3, description="[1/s] of its change, over the thrust at rest; larger: quicker, less smooth"
    )
    end: Annotated[Float, Between(0, 1000, "s")] = Field(
        0.2, description="[s] that the last state counts for: what comes after the horizon"
    )
    least_tension: Annotated[Float, Between(0, 10)] = Field(
        0.05, description="[-] of each cable, over its tension at rest; less costs as much as `tension` below it says"
    )
    tension: Annotated[Float, Between(1e-4, 10)] = Field(0.03, description="[-] tolerance of what is missing, likewise")
    largest_thrust: Annotated[Float, Between(0.1, 2)] = Field(0.95, description="[-] over what the rotors can give")
    least_thrust: Annotated[Float, Between(0, 1)] = Field(
        0.1, description="[-] over the thrust at rest, with hard limits"
    )
    largest_tilt: Annotated[Float, Between(1, 89, "deg")] = Field(
        70.0, description="[deg] of each thrust vector from the vertical, with hard limits"
    )
    separation: Annotated[Float, Between(0, 10)] = Field(
        1.1, description="[-] least distance of drones, over that which counts as a collision"
    )
    cables: Annotated[Float, Between(0, 10)] = Field(
        1.1, description="[-] least distance of cables, over that which counts as crossing, with hard limits"
    )
    clearance: Annotated[Float, Between(0, 10, "m")] = Field(
        0.1, description="[m] least distance of drones, cables and payload from obstacles, with soft limits"
    )
    clearance_tolerance: Annotated[Float, Between(1e-3, 10, "m")] = Field(
        0.03, description="[m] tolerance of what is missing"
    )
    estimate: bool = Field(
        True, description="whether forces on payload and drones, a moment and mass of the payload are estimated"
    )
    estimate_noise: Annotated[Float | None, Between(1e-3, 1000)] = Field(
        None,
        description="[-] of accelerations as measured for that, over gravity; larger: slower; None: 0.5 with "
        "env.sensing=ideal and no observation_noise, 2 with onboard and blind, else 1",
    )
    feedback: Annotated[Float, Between(0, 1)] = Field(
        1.0,
        description="[-] share of what is measured beside the last plan, by which the start of each plan is corrected; "
        "below 1, with control.action=full_state, drones that answer late follow plans rather than measurements",
    )
    delay: Annotated[Float, Between(0, 1, "s")] = Field(
        0.0, description="[s] by which actions and what is measured are late: the plan begins with the state then"
    )
    lead: Annotated[Float | None, Between(0, 1, "s")] = Field(
        None, description="[s] thrusts are commanded ahead of the plan; None: motor lag and half a policy step"
    )
    deadline: Annotated[Float | None, Between(1e-4, 10, "s")] = Field(
        None,
        description="[s] a plan may take, in the mean of the teams that are planned together; a later one is not flown "
        "(planner_late); None: simulated time waits",
    )
    patience: Annotated[Float, Between(0, 10, "s")] = Field(
        0.5, description="[s] without a plan in time, after which a linear baseline flies"
    )
