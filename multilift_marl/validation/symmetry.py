"""A team without any symmetry, in plain arrays; its mirrored, turned and renumbered twins move like it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from multilift_marl.config.config import Config
from multilift_marl.config.load import load_config
from multilift_marl.control.formation import (
    Goal,
    Reference,
    Smoothing,
    place_formation,
    smooth,
    start_reference,
)
from multilift_marl.control.gains import make_gains
from multilift_marl.control.geometric import fly
from multilift_marl.rig.constants import make_rig
from multilift_marl.sim.world import World
from multilift_marl.validation.experiment import Plot, Result

CONTROL_HZ = 250.0
Map = Callable[[np.ndarray], np.ndarray]
_LIMIT = 1e-6
_TURN = np.deg2rad(73.0)
_ORDER = np.array([2, 0, 3, 1])
_MIRROR = np.diag([1.0, -1.0, 1.0])


@dataclass(frozen=True)
class Team:
    """A team before its flight, in arrays that can be mirrored, turned and renumbered; nothing in it is symmetric."""

    anchors: np.ndarray
    """(N, 3) from the payload's geometric centre [m]."""
    length: np.ndarray
    """(N,) of the cables [m]."""
    middle: np.ndarray
    """(3,) centre of mass from the geometric centre [m]."""
    azimuth: np.ndarray
    """(4,) of the rotors [deg]."""
    spin: np.ndarray
    """(4,)."""
    wind: np.ndarray
    """(3,) [m/s]."""
    force: np.ndarray
    """(3,) hidden, on the payload [N]."""
    target: np.ndarray
    """(3,) of the payload [m]."""
    yaw: float
    """Of the target and at the start [rad]."""
    position: np.ndarray
    """(1 + N, 3) of payload and drones at the start [m], and their other states."""
    rotation: np.ndarray
    velocity: np.ndarray
    rates: np.ndarray
    model: str = "massless"
    timestep: float = 0.004
    """[s]"""

    @property
    def world(self) -> World:
        """The simulation of the team at its start."""
        world = World(self.config.system, 1, 1)
        state = world.state
        for payload, drones, values in (
            (state.payload_position, state.drone_position, self.position),
            (state.payload_rotation, state.drone_rotation, self.rotation),
            (state.payload_velocity, state.drone_velocity, self.velocity),
            (state.payload_body_rates, state.drone_body_rates, self.rates),
        ):
            payload[0] = values[0]
            drones[0] = values[1:]
        world.hidden_loads.wind[0] = self.wind
        world.hidden_loads.payload_force[0] = self.force
        world.load(np.ones(1, bool))
        return world

    @property
    def config(self) -> Config:
        """The configuration of the team."""
        return load_config(
            "hover",
            {
                "payload.anchors": self.anchors.tolist(),
                "payload.center_of_mass": self.middle.tolist(),
                "cable.length": self.length.tolist(),
                "cable.model": self.model,
                "sim.timestep": self.timestep,
                "sim.control_hz": CONTROL_HZ,
                "vehicle.rotor_azimuth": self.azimuth.tolist(),
                "vehicle.rotor_spin": self.spin.tolist(),
            },
        )


def make_team(model: str) -> Team:
    """Return a team that starts 0.3 m off its target, moving, turning and with some cables slack."""
    rng = np.random.default_rng(7)
    team = Team(
        anchors=np.array([[0.27, 0.22, 0.08], [-0.25, 0.20, 0.08], [-0.27, -0.15, 0.08], [0.20, -0.22, 0.08]]),
        length=np.array([1.0, 1.1, 0.9, 1.05]),
        middle=np.array([0.03, -0.02, 0.01]),
        azimuth=np.array([45.0, 135.0, 225.0, 315.0]),
        spin=np.array([1.0, -1.0, 1.0, -1.0]),
        wind=np.array([3.0, 1.0, 0.0]),
        force=np.array([0.8, -0.5, 0.0]),
        target=np.array([0.4, 0.2, 1.5]),
        yaw=0.0,
        position=np.zeros((5, 3)),
        rotation=np.zeros((5, 3, 3)),
        velocity=rng.uniform(-0.3, 0.3, (5, 3)),
        rates=rng.uniform(-0.5, 0.5, (5, 3)),
        model=model,
    )
    system = team.config.system
    closer = np.concatenate([[[0, 0, 0]], rng.uniform(0, 0.02, (4, 1)) * (system.anchors - system.slots)])
    rest = World(system, 1, 1).state
    position = np.concatenate([rest.payload_position, rest.drone_position[0]]) + closer + [0.2, -0.1, 0.2]
    return replace(team, position=position, rotation=np.concatenate([rest.payload_rotation, rest.drone_rotation[0]]))


def about_z(angle: float) -> np.ndarray:
    """Return the rotation (3, 3) by an angle [rad] about the vertical."""
    c = np.cos(angle)
    s = np.sin(angle)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])


def take_off(team: Team) -> tuple[World, Callable[[], None]]:
    """Return the team's simulation at its start, and the `controller` to its target; wind and force are hidden."""
    world = team.world
    return world, controller(team.config, world, team.target, team.yaw)


def controller(config: Config, world: World, target: np.ndarray, yaw: float = 0.0) -> Callable[[], None]:
    """Return the call that writes the thrusts of one control step of the first environment.

    Args:
        config: of the team.
        world: its simulation.
        target: about which the drones hold the resting formation, behind smoothed references (3,) [m].
        yaw: of target and drones [rad].
    """
    system = config.system
    option = config.control
    goal = Goal.zeros(1, system.num_drones)
    reference = Reference.zeros(1, system.num_drones)
    goal.position[0] = target
    goal.rotation[0] = about_z(yaw)
    place_formation(0, goal, make_rig(system))
    start_reference(0, world.state, reference)
    reference.command[:] = goal.slots
    reference.command_yaw[:] = yaw
    gains = make_gains(option, system)
    smoothing = Smoothing(option.reference_frequency, option.reference_speed, 1 / config.sim.control_hz)

    def steer() -> None:
        smooth(0, 1, reference, smoothing)
        fly(0, 1, world.state, reference, goal.cable_force, world.thrust, gains)

    return steer


def poses(world: World) -> tuple[np.ndarray, np.ndarray]:
    """Return positions (1 + N, 3) [m] and attitudes (1 + N, 3, 3) of payload and drones of the first environment."""
    state = world.state
    position = np.concatenate([state.payload_position[:1], state.drone_position[0]])
    return position, np.concatenate([state.payload_rotation[:1], state.drone_rotation[0]])


def velocities(world: World) -> tuple[np.ndarray, np.ndarray]:
    """Return velocities (1 + N, 3) [m/s] and body rates (1 + N, 3) [rad/s] of the same."""
    state = world.state
    velocity = np.concatenate([state.payload_velocity[:1], state.drone_velocity[0]])
    return velocity, np.concatenate([state.payload_body_rates[:1], state.drone_body_rates[0]])


def turned(team: Team, angle: float = _TURN) -> Team:
    """Return the team turned about the vertical by `angle` [rad]."""
    r = about_z(angle)
    return replace(
        team, wind=r @ team.wind, force=r @ team.force, target=r @ team.target, yaw=team.yaw + angle,
        position=team.position @ r.T, rotation=r @ team.rotation, velocity=team.velocity @ r.T,
    )  # fmt: skip


def mirrored(team: Team) -> Team:
    """Return the team behind a mirror in the x-z plane: y, the rotors' sense and all rotation reversed."""
    m = _MIRROR
    return replace(
        # Body rates are an axial vector, of which a mirror reverses the other components: -M Ω.
        team, anchors=team.anchors @ m, middle=m @ team.middle, azimuth=-team.azimuth, spin=-team.spin,
        wind=m @ team.wind, force=m @ team.force, target=m @ team.target, yaw=-team.yaw,
        position=team.position @ m, rotation=m @ team.rotation @ m, velocity=team.velocity @ m, rates=-team.rates @ m,
    )  # fmt: skip


def renumbered(team: Team, order: np.ndarray = _ORDER) -> Team:
    """Return the team with its drones in another order (N,)."""
    rows = np.concatenate([[0], 1 + order])
    return replace(
        team, anchors=team.anchors[order], length=team.length[order], position=team.position[rows],
        rotation=team.rotation[rows], velocity=team.velocity[rows], rates=team.rates[rows],
    )  # fmt: skip


def fly_home(team: Team, seconds: float) -> tuple[np.ndarray, np.ndarray]:
    """Let the team fly to its target in formation.

    Returns:
        Positions (T, 1 + N, 3) [m] and attitudes (T, 1 + N, 3, 3) of payload and drones after every control step.
    """
    (world, steer), position, rotation = take_off(team), [], []
    for _ in range(round(seconds * CONTROL_HZ)):
        steer()
        world.step(world.thrust, world.system.control_interval)
        where, how = poses(world)
        position.append(where)
        rotation.append(how)
    return np.array(position), np.array(rotation)


def symmetry(fast: bool) -> Result:
    """A team without any symmetry flies to its target in wind; so do its turned, mirrored and renumbered twins."""
    caption = "Largest difference of the twins' positions from those of the first team, mapped in the same way."
    title = "how far twins differ over the flight"
    plot = Plot("symmetry", title, "time [s]", "largest difference [m]", caption=caption, log="y")
    result = Result(plots=[plot])
    for model in ("massless", "chain"):
        team = make_team(model)
        seconds = 2.0 if fast and model == "chain" else 5.0
        position, rotation = fly_home(team, seconds)
        time = np.arange(1, len(position) + 1) / CONTROL_HZ
        for name, twin, map_position, map_rotation in _twins(team):
            other, attitude = fly_home(twin, seconds)
            apart = np.abs(other - map_position(position)).max(axis=(1, 2))
            error = float(max(apart.max(), np.abs(attitude - map_rotation(rotation)).max()))
            quantity = f"largest difference of positions [m] and attitudes in {seconds:g} s"
            result.check(f"symmetry, {model}, {name}", quantity, error, _LIMIT)
            same = "" if apart.any() else " (no bit differs)"
            plot.add(f"{model}, {name}{same}", time, np.where(apart > 0, apart, np.nan))
    return result


def _twins(team: Team) -> list[tuple[str, Team, Map, Map]]:
    """Return names, teams, and how positions and attitudes of the first team map to each one's."""
    r = about_z(_TURN)
    m = _MIRROR
    rows = np.concatenate([[0], 1 + _ORDER])
    return [
        ("turned by 73°", turned(team), lambda p: p @ r.T, lambda a: r @ a),
        ("mirrored", mirrored(team), lambda p: p @ m, lambda a: m @ a @ m),
        ("renumbered", renumbered(team), lambda p: p[:, rows], lambda a: a[:, rows]),
    ]
