"""Mirrored, turned and renumbered teams fly mirrored, turned and renumbered: no axis, side or index is special."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from multilift_marl.validation.asymmetric_team import CONTROL_HZ, Team, about_z, make_team, poses, take_off
from multilift_marl.validation.experiment import Curve, Plot, Result, Row

Map = Callable[[np.ndarray], np.ndarray]
_LIMIT = 1e-6
_TURN = np.deg2rad(73.0)
_ORDER = np.array([2, 0, 3, 1])
_MIRROR = np.diag([1.0, -1.0, 1.0])


def turned(team: Team, angle: float = _TURN) -> Team:
    """Return the team turned about the vertical by `angle` [rad]."""
    r = about_z(angle)
    return replace(
        team, wind=r @ team.wind, force=r @ team.force, target=r @ team.target, yaw=team.yaw + angle,
        position=team.position @ r.T, rotation=r @ team.rotation, velocity=team.velocity @ r.T,
    )  # fmt: skip


def mirrored(team: Team) -> Team:
    """Return the team behind a mirror in the x-z plane: y, the rotors' sense and all turning the other way round."""
    m = _MIRROR
    return replace(
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
    result = Result()
    plot = Plot("symmetry", "how far twins differ over the flight", "time [s]", "largest difference [m]", semilog=True)
    plot.caption = "Largest difference of the twins' positions from those of the first team, mapped the same way."
    for model in ("massless", "chain"):
        team, seconds = make_team(model), 2.0 if fast and model == "chain" else 5.0
        position, rotation = fly_home(team, seconds)
        time = np.arange(1, len(position) + 1) / CONTROL_HZ
        for name, twin, map_position, map_rotation in _twins(team):
            other, attitude = fly_home(twin, seconds)
            apart = np.abs(other - map_position(position)).max(axis=(1, 2))
            error = float(max(apart.max(), np.abs(attitude - map_rotation(rotation)).max()))
            quantity = f"largest difference of positions [m] and attitudes in {seconds:g} s"
            result.rows.append(Row(f"symmetry, {model}, {name}", quantity, 0.0, error, error, _LIMIT))
            same = "" if apart.any() else " (no bit differs)"
            plot.curves.append(Curve(f"{model}, {name}{same}", time, np.where(apart > 0, apart, np.nan)))
    result.plots.append(plot)
    return result


def _twins(team: Team) -> list[tuple[str, Team, Map, Map]]:
    """Return names, teams, and how positions and attitudes of the first team map to each one's."""
    r, m = about_z(_TURN), _MIRROR
    rows = np.concatenate([[0], 1 + _ORDER])
    return [
        ("turned by 73°", turned(team), lambda p: p @ r.T, lambda a: r @ a),
        ("mirrored", mirrored(team), lambda p: p @ m, lambda a: m @ a @ m),
        ("renumbered", renumbered(team), lambda p: p[:, rows], lambda a: a[:, rows]),
    ]
