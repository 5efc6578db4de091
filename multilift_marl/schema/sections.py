"""Every parameter, once: type, default, unit and meaning. YAML files and overrides only change these values."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import AfterValidator, Field, create_model, field_validator, model_validator

from multilift_marl.schema.control import ControlConfig
from multilift_marl.schema.files import pin_text, pin_vehicles
from multilift_marl.schema.obstacle_sensing import ObstacleSensingConfig
from multilift_marl.schema.scene import SceneConfig
from multilift_marl.schema.values import (
    Between,
    Delays,
    Drag,
    Float,
    FloatPerDrone,
    FourPerDrone,
    History,
    Int,
    Lean,
    Level,
    Links,
    Moments,
    NotNegative,
    NotNegativePerDrone,
    PerDrone,
    Positive,
    Section,
    Share,
    Vector,
    VectorPerDrone,
)


class EnvConfig(Section):
    """Size and timing of the environment."""

    num_drones: Int = Field(4, ge=1, le=64, description="drones in a team")
    num_envs: Annotated[Int, Between(1, 1e5)] = Field(128, ge=1, description="environments stepped together")
    num_threads: Annotated[Int, Between(0, 1024)] = Field(
        0, ge=0, description="threads that step them; 0: one for each CPU"
    )
    episode_seconds: Annotated[Float, Between(0, 1e6, "s")] = Field(
        8.0, gt=0, description="[s] time limit of an episode"
    )
    policy_hz: Annotated[Float, Between(1, 1e5, "Hz")] = Field(
        50.0, gt=0, description="[Hz] rate of actions and observations"
    )
    sensing: Literal["ideal", "mocap", "rtk", "onboard", "blind"] = Field(
        "ideal", description="what drones know of themselves and of the payload (docs/sensing.md)"
    )
    communication: Literal["none", "neighbours", "all"] = Field(
        "none", description="with sensing=onboard: from which drones a drone receives where their cables end"
    )
    communication_delay: Int = Field(1, ge=0, le=100, description="[policy steps] until a message is heard")
    communication_loss: Float = Field(0.0, ge=0, le=1, description="[-] share of the messages that are lost")
    communication_range: Annotated[Float | None, Between(0, 1e6, "m")] = Field(
        None, description="[m] beyond which drones do not hear each other; None: no limit"
    )
    obstacle_sensing: Literal["none", "map", "local", "ranges"] = Field(
        "none", description="what drones observe of obstacles: nearest points, exact or of a sensor, or ranges"
    )
    obstacles: ObstacleSensingConfig = ObstacleSensingConfig()
    units: Literal["si", "cable"] = Field(
        "si", description="of observations and full actions; cable: those of the similar rig with cables of 1 m"
    )
    history: History = Field(
        1, description="steps that an observation holds, the newest first; or how many steps ago each is, [0, ...]"
    )

    @property
    def length(self) -> float:
        """How long an episode is [s]: `episode_seconds` in whole policy steps."""
        return round(self.episode_seconds * self.policy_hz) / self.policy_hz

    @property
    def ages(self) -> tuple[int, ...]:
        """How many steps ago each observation is that drones hold."""
        return tuple(range(self.history)) if isinstance(self.history, int) else self.history


class SimConfig(Section):
    """Time steps of physics and control."""

    timestep: Float = Field(0.004, ge=1e-5, le=0.02, description="[s] physics step")
    control_hz: Annotated[Float, Between(1, 1e5, "Hz")] = Field(
        250.0, gt=0, description="[Hz] rate of the drones' controllers"
    )


class VehicleConfig(Section):
    """The quadrotors: a preset, and what differs from it (None: as the preset); lists hold one for each drone."""

    preset: Annotated[str | tuple[str, ...], AfterValidator(pin_vehicles)] = Field(
        "falcon",
        description="falcon, crazyflie, crazyflie_id, hummingbird, iris, x500, or one's own: a name, YAML or URDF file",
    )
    mass: Annotated[PerDrone | None, Between(1e-4, 1e7, "kg")] = Field(None, description="[kg] of the whole drone")
    inertia: Annotated[Moments | tuple[Moments, ...] | None, Between(1e-9, 1e7, "kg m²")] = Field(
        None, description="[kg m²] principal moments"
    )
    arm: Annotated[PerDrone | None, Between(0.01, 10, "m")] = Field(
        None, description="[m] from the centre of mass to a rotor axis"
    )
    rotor_azimuth: Annotated[FourPerDrone | None, Between(-360, 360, "deg")] = Field(
        None, description="[deg] directions of the arms, counter-clockwise from body x"
    )
    rotor_spin: FourPerDrone | None = Field(
        None, description="[-] 1 or -1, sign of each rotor's reaction torque about body z"
    )
    thrust_coefficient: Annotated[PerDrone | None, Between(1e-12, 1, "N s²")] = Field(
        None, description="[N s²] b in thrust = b · speed²"
    )
    torque_ratio: Annotated[PerDrone | None, Between(1e-12, 10, "m")] = Field(
        None, description="[m] reaction torque over thrust"
    )
    rotor_time_constant_up: Annotated[PerDrone | None, Between(1e-4, 10, "s")] = Field(
        None, description="[s] lag of a rising rotor speed"
    )
    rotor_time_constant_down: Annotated[PerDrone | None, Between(1e-4, 10, "s")] = Field(
        None, description="[s] lag of a falling rotor speed"
    )
    rotor_speed_min: Annotated[NotNegativePerDrone | None, Between(0, 1e6, "rad/s")] = Field(
        None, description="[rad/s] idle speed"
    )
    rotor_thrust_max: Annotated[PerDrone | None, Between(1e-4, 1e9, "N")] = Field(
        None, description="[N] largest thrust of one rotor"
    )
    drag: Annotated[Drag | tuple[Drag, ...] | None, Between(0, 1e4, "kg/s")] = Field(
        None, description="[kg/s] linear drag along the body axes"
    )
    rotor_radius: Annotated[PerDrone | None, Between(1e-4, 10, "m")] = Field(
        None, description="[m] for wash, inflow and ground effect"
    )
    rotor_solidity: Annotated[PerDrone | None, Between(1e-3, 1)] = Field(
        None, description="[-] area of a rotor's blades over that of its disc, for inflow"
    )
    rolling_moment: Annotated[NotNegativePerDrone | None, Between(0, 1, "kg m")] = Field(
        None, description="[kg m] moment of a rotor over its speed and that of the air across it"
    )
    rotor_inertia: Annotated[NotNegativePerDrone | None, Between(0, 1, "kg m²")] = Field(
        None, description="[kg m²] of one rotor about its axis; 0: no spin-up and no precession torque"
    )


class PayloadConfig(Section):
    """The load. None stands for the standard rig: 0.35 kg a falcon, a box that carries the ring of anchors."""

    shape: Literal["box", "cylinder", "mesh", "point"] = Field(
        "box", description="box, upright cylinder, mesh, or point: a mass without extent"
    )
    mesh: Annotated[str | None, AfterValidator(pin_text)] = Field(
        None, description="path of an .obj or .stl file, a closed surface, for shape mesh"
    )
    origin: Literal["center", "file"] = Field(
        "center", description="of center_of_mass and anchors: geometric centre, or that of a mesh's file, as scaled"
    )
    mass: Annotated[Float | None, Between(1e-4, 1e7, "kg")] = Field(
        None, gt=0, description="[kg] None: 0.35 kg for each falcon, others by spare thrust"
    )
    size: Annotated[tuple[Positive, Positive, Positive] | None, Between(1e-3, 100, "m")] = Field(
        None,
        description="[m] edges of the box, or diameter twice and height of the cylinder; mesh: scaled to; None: fits",
    )
    inertia: Annotated[tuple[Positive, Positive, Positive] | None, Between(1e-9, 1e7, "kg m²")] = Field(
        None, description="[kg m²] principal moments about the centre of mass; None: of a uniform body"
    )
    center_of_mass: Annotated[Vector | None, Between(-100, 100, "m")] = Field(
        None, description="[m] of the centre of mass from the geometric centre; None: of a uniform body"
    )
    anchors: Annotated[tuple[Vector, ...] | None, Between(-100, 100, "m")] = Field(
        None, description="[m] attachment of each cable from the geometric centre; None: the standard rig's"
    )
    anchor_radius: Annotated[Positive | None, Between(1e-3, 100, "m")] = Field(
        None, description="[m] of a ring on which the cables are attached; None: the standard rig's, or anchors"
    )
    drag_area: Annotated[Float, Between(0, 1000, "m²")] = Field(
        0.09, ge=0, description="[m²] C_d A of the payload (cube C_d 1.05 on its smaller faces)"
    )


class CableConfig(Section):
    """The cables; lists hold one value for each drone."""

    model: Literal["massless", "chain"] = Field(
        "massless", description="massless: tension-only Kelvin-Voigt element; chain: masses, springs and dampers"
    )
    length: Annotated[PerDrone | None, Between(1e-3, 1000, "m")] = Field(
        None, description="[m] natural length; None: 1 m, more if a point load needs it"
    )
    stiffness: Annotated[PerDrone, Between(0.01, 1e9, "N/m")] = Field(1e5, description="[N/m] of the whole cable")
    damping: Annotated[PerDrone, Between(1e-9, 1e9, "N s/m")] = Field(1e3, description="[N s/m] of the whole cable")
    breaking_load: Annotated[PerDrone | None, Between(1e-3, 1e9, "N")] = Field(
        None, description="[N] tension that breaks a cable; None: none does"
    )
    segments: Links | tuple[Links, ...] = Field(10, description="links of a chain")
    density: Annotated[PerDrone, Between(1e-9, 100, "kg/m")] = Field(0.01, description="[kg/m] of a chain")
    bending_stiffness: Annotated[Float, Between(0, 1000, "N m/rad")] = Field(
        0.0, ge=0, description="[N m/rad] between the links of a chain"
    )
    bending_damping: Annotated[Float | None, Between(0, 1000, "N m s/rad")] = Field(
        None, ge=0, description="[N m s/rad] between the links of a chain; None: 90/s × mass of a node × link²"
    )
    hook: Annotated[VectorPerDrone, Between(-10, 10, "m")] = Field(
        (0.0, 0.0, 0.0), description="[m] where the cable is tied to its drone, from its centre of mass, body frame"
    )
    angle: Lean | tuple[Lean, ...] = Field(
        30.0, description="[deg] cables from the vertical at rest: one value is approached, a list is held"
    )
    azimuth: Annotated[FloatPerDrone | None, Between(-360, 360, "deg")] = Field(
        None,
        description="[deg] of cables from their anchors at rest, counter-clockwise from the payload's x; held; None: "
        "near the directions away from the middle of the anchors",
    )


class RandomizationConfig(Section):
    """What each episode draws anew, always from the nominal values; hidden from the drones (docs/randomization.md)."""

    payload_mass: Share = Field(0.0, description="[-] mass and inertia scaled by 1 ± this, uniform")
    payload_inertia: Share = Field(0.0, description="[-] inertia, beside that, scaled by 1 ± this, uniform")
    payload_center_of_mass: Annotated[tuple[NotNegative, NotNegative, NotNegative], Between(0, 10, "m")] = Field(
        (0.0, 0.0, 0.0), description="[m] moved by ± this along each axis, uniform"
    )
    payload_drag: Share = Field(0.0, description="[-] drag of the payload scaled by 1 ± this, uniform")
    payload_force: Annotated[Float, Between(0, 1e6, "N")] = Field(
        0.0, ge=0, description="[N] constant horizontal force, magnitude uniform up to this"
    )
    cable_length: Share = Field(0.0, description="[-] length of each cable scaled by 1 ± this, uniform")
    cable_stiffness: Share = Field(0.0, description="[-] stiffness of each cable scaled by 1 ± this, uniform")
    vehicle_mass: Share = Field(0.0, description="[-] mass and inertia of each drone scaled by 1 ± this, uniform")
    vehicle_thrust_coefficient: Share = Field(
        0.0, description="[-] of each drone's rotors, scaled by 1 ± this, uniform"
    )
    vehicle_rotor_time_constant: Share = Field(
        0.0, description="[-] of each drone's rotors, up and down, scaled by 1 ± this, uniform"
    )
    rotor_thrust_coefficient: Share = Field(
        0.0, description="[-] of each single rotor, beside that of all of its drone's, scaled by 1 ± this, uniform"
    )
    vehicle_drag: Share = Field(0.0, description="[-] drag of each drone scaled by 1 ± this, uniform")
    wind: Annotated[Float, Between(0, 60, "m/s")] = Field(
        0.0, ge=0, description="[m/s] horizontal mean wind, beside wind.velocity, uniform up to this"
    )
    observation_noise: Annotated[Level, Between(0, 100)] = Field(
        0.0, description="none, standard or a factor on it: white noise, each policy step"
    )
    observation_bias: Annotated[Level, Between(0, 100)] = Field(
        0.0, description="none, standard or a factor on it: constant in an episode"
    )
    observation_delay: Delays = Field((0, 0), description="[policy steps] a number, or the range of a uniform draw")
    action_delay: Delays = Field((0, 0), description="[policy steps] a number, or the range of a uniform draw")

    @property
    def weakest_rotor(self) -> float:
        """Smallest thrust of a rotor over the nominal one [-]."""
        return (1 - self.vehicle_thrust_coefficient) * (1 - self.rotor_thrust_coefficient)

    @property
    def strongest_rotor(self) -> float:
        """Largest thrust of a rotor over the nominal one [-]."""
        return (1 + self.vehicle_thrust_coefficient) * (1 + self.rotor_thrust_coefficient)


class WindConfig(Section):
    """The air (docs/air.md)."""

    velocity: Annotated[Vector, Between(-60, 60, "m/s")] = Field(
        (0.0, 0.0, 0.0), description="[m/s] mean wind in the world frame"
    )
    turbulence: bool = Field(False, description="Dryden turbulence of MIL-F-8785C")
    turbulence_speed: Annotated[Float | None, Between(0, 60, "m/s")] = Field(
        None, ge=0, description="[m/s] horizontal mean wind that turbulence is as strong as; None: the one there is"
    )
    gust: Annotated[Vector, Between(-60, 60, "m/s")] = Field(
        (0.0, 0.0, 0.0), description='[m/s] amplitude of a "1 - cosine" gust in the world frame'
    )
    gust_start: Annotated[Float, Between(0, 1e6, "s")] = Field(2.0, ge=0, description="[s] from start to gust")
    gust_rise: Annotated[Float, Between(1e-3, 1e6, "s")] = Field(
        0.5, gt=0, description="[s] in which it rises, and falls"
    )
    gust_hold: Annotated[Float | None, Between(0, 1e6, "s")] = Field(
        1.0, ge=0, description="[s] that it lasts in between; None: for good"
    )
    wash: bool = Field(False, description="rotor wash of each drone on the drones and the payload below it")
    inflow: bool | None = Field(
        None, description="less thrust in air that comes along the rotors' axes (blade elements); None: as wash"
    )
    ground_effect: bool = Field(False, description="more thrust near the ground (Cheeseman and Bennett 1955)")
    roll_moment: Annotated[Float, Between(-1000, 1000, "N s")] = Field(
        0.0, description="[N s] moment about body x for each m/s through the air along body y (report eqs 12-13)"
    )


class ContactConfig(Section):
    """Contact of ground, payload and drones (docs/contact.md)."""

    friction: Annotated[Float, Between(0, 10)] = Field(
        1.0, ge=0, description="[-] coefficient of sliding friction, the same in all directions"
    )
    restitution: Annotated[Float, Between(0, 0.95)] = Field(
        0.0, ge=0, description="[-] speed after an impact over that before"
    )


class PushConfig(Section):
    """Sudden changes of velocity of single bodies at random times (docs/randomization.md)."""

    interval: Annotated[Float, Between(0.01, 1e6, "s")] = Field(
        5.0, gt=0, description="[s] mean time between two pushes of a body"
    )
    payload_velocity: Annotated[Float, Between(0, 10, "m/s")] = Field(
        0.0, ge=0, description="[m/s] change of the payload's velocity, size uniform up to this, any direction"
    )
    drone_velocity: Annotated[Float, Between(0, 10, "m/s")] = Field(
        0.0, ge=0, description="[m/s] the same of a drone's velocity"
    )
    drone_rates: Annotated[Float, Between(0, 30, "rad/s")] = Field(
        0.0, ge=0, description="[rad/s] the same of its body rates, at the same time"
    )


class RewardTerm(Section):
    """A reward term's own numbers; a bare number is its weight."""

    weight: Annotated[Float, Between(-1e6, 1e6)] | None = Field(None, description="[-] None: the task's own")
    margin: tuple[Annotated[Float, Between(1e-6, 1e6)], ...] | None = Field(
        None, description="errors, one or a list, that halve its value, in the term's units; None: the task's own"
    )

    @model_validator(mode="before")
    @classmethod
    def _from_number(cls, value: Any) -> Any:
        return value if isinstance(value, dict | RewardTerm) else {"weight": value}

    @field_validator("margin", mode="before")
    @classmethod
    def _one_margin(cls, value: Any) -> Any:
        return (value,) if isinstance(value, int | float) else value


if TYPE_CHECKING:
    _Imports = Section
else:  # a class statement cannot have a field of this name, a word of Python
    _modules = Field((), description="modules of one's own, names or .py files (docs/plugins.md)")
    _Imports = create_model("_Imports", __base__=Section, **{"import": (tuple[str, ...], _modules)})


class SystemConfig(_Imports):
    """What is simulated; `rig.resolve.resolve_system` computes its numbers."""

    task: str = Field("hover", description="name of the task")
    seed: Int = Field(0, ge=0, lt=2**63, description="seed of everything random")
    env: EnvConfig = EnvConfig()
    sim: SimConfig = SimConfig()
    vehicle: VehicleConfig = VehicleConfig()
    payload: PayloadConfig = PayloadConfig()
    cable: CableConfig = CableConfig()
    control: ControlConfig = ControlConfig()
    randomization: RandomizationConfig = RandomizationConfig()
    wind: WindConfig = WindConfig()
    push: PushConfig = PushConfig()
    contact: ContactConfig = ContactConfig()
    scene: SceneConfig = SceneConfig()
