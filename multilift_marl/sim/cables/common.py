"""Common to cable models: the numbers of a rig's cables, the law of a cable, bounds and statistics of tensions."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from multilift_marl.kernels.jit import kernel
from multilift_marl.rig.constants import make_rig
from multilift_marl.rig.system import System
from multilift_marl.sim.parameters import Parameters

MAX_SPEED = 100.0  # [m/s] beyond which a simulation has diverged: 1.7 times the fastest wind that is accepted
MAX_RATE = 500.0  # [rad/s] beyond which it has: ten times the change that a physics step may make
MAX_STRETCH = 0.2  # [-] of a cable's length beyond which it has: twice that of any resting cable


class Cables(NamedTuple):
    """The cables of a rig, the true ones of each environment."""

    timestep: float
    """[s]"""
    anchors: np.ndarray
    """(N, 3) on the payload, from the origin of its frame [m]."""
    hooks: np.ndarray
    """(N, 3) on the drones, from their centres of mass [m]."""
    length: np.ndarray
    """(E, N) [m], of `Parameters`."""
    stiffness: np.ndarray
    """(E, N) [N/m], of `Parameters`."""
    damping: np.ndarray
    """(N,) [N s/m]."""
    breaking_load: np.ndarray
    """(N,) [N]."""


def make_common(system: System, parameters: Parameters) -> Cables:
    """Return the cables of `system` with live parameters."""
    rig = make_rig(system)
    return Cables(
        timestep=system.timestep,
        anchors=rig.anchors,
        hooks=rig.hooks,
        length=parameters.cable_length,
        stiffness=parameters.cable_stiffness,
        damping=np.ascontiguousarray(system.cable_damping),
        breaking_load=system.breaking_load,
    )


@kernel
def cable_tension(stiffness, damping, stretch, rate):
    """Return the tension [N] of a spring and damper at a stretch [m] and its rate [m/s], never negative.

    MuJoCo's tendon limits have the same law (`massless.limit_solref`); links of chains have it at the end of a substep,
    implicitly and of both signs (`chain_solver.py`).
    """
    return max(0.0, stiffness * stretch + damping * rate)


@kernel
def clear_stats(e, stats):
    """Start the statistics of environment e anew."""
    stats.energy[e] = 0.0
    stats.slack_time[e] = 0.0
    stats.tension_min[e] = 1e9  # above any tension
    stats.tension_max[e] = 0.0
    stats.tension_peak[e] = 0.0
    stats.stretch_max[e] = 0.0


@kernel
def update_tension_stats(rows, mask, value, data, cables):
    """Add the tensions of the environments of `rows` where `mask` (E,) is `value` to the statistics; break cables.

    One call serves all environments, because handing over a named tuple costs two atomic operations for each array.
    """
    state = data.state
    stats = data.stats
    for e in range(rows.first, rows.first + rows.state.shape[0]):
        if mask[e] != value:
            continue
        for n in range(cables.breaking_load.shape[0]):
            tension = state.cable_tension[e, n]
            if tension > cables.breaking_load[n]:
                state.cable_broken[e, n] = True
            stats.tension_min[e] = min(stats.tension_min[e], tension)
            stats.tension_max[e] = max(stats.tension_max[e], tension)
            stats.tension_peak[e] = max(stats.tension_peak[e], tension)
            # Of a cable at rest under this tension: T/(k L).
            stats.stretch_max[e] = max(stats.stretch_max[e], tension / (cables.stiffness[e, n] * cables.length[e, n]))
