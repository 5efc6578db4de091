"""States of teams from noisy and late measurements, by the reduced model: an alpha-beta filter about its prediction.

Filters of sensors know no thrusts, so what they say of velocities is late where a payload accelerates. The model does:
places are corrected by a share of what is measured beside the prediction, velocities by what this asks for (Kalata,
IEEE TAES 20(2), 1984). Thrust vectors are taken as measured.
"""

from __future__ import annotations

from math import sqrt

import numpy as np

from multilift_marl.control.formation import wrap
from multilift_marl.kernels.jit import kernel
from multilift_marl.math3d import add, cross, dot, norm, row, scale
from multilift_marl.planning.team_model import ModelWork, TeamModel, euler_rates, set_rotation, step_state


class TeamObserver:
    """States of E teams.

    Args:
        model: nominal.
        num_envs: E.
        share: of what is measured, by which places are corrected in each step [-].
        late: by which the payload's pose is late [s].

    Attributes:
        states: (E, 12 + 7 N), live.
        fresh: (E,) bool, teams whose state is taken as measured.
    """

    def __init__(self, model: TeamModel, num_envs: int, share: float, late: float):
        n = len(model.anchors)
        self.states, self.fresh = np.zeros((num_envs, 12 + 7 * n)), np.ones(num_envs, bool)
        self._model, self._gains = model, (share, share**2 / (2.0 - share), late)
        self._work, self._after, self._rate = ModelWork.of(n), np.zeros(12 + 7 * n), np.zeros(3 * n)
        self._seen = np.zeros(6 + 2 * n)

    def update(self, measured: np.ndarray, dt: float, loads: np.ndarray) -> np.ndarray:
        """Return the states, live, by what is measured (E, 12 + 7 N) `dt` [s] after the last, under loads (E, 7)."""
        own, arrays = (self.states, self.fresh), (self._work, self._after, self._rate, self._seen)
        _update(measured, dt, np.ascontiguousarray(loads), own, self._model, self._gains, arrays)
        return self.states


@kernel
def _update(measured, dt, loads, own, model, gains, arrays):
    states, fresh = own
    share, following, late = gains
    work, after, rate, seen = arrays
    nu = rate.shape[0]
    q = 6 + 2 * (nu // 3)
    for e in range(measured.shape[0]):
        x, y = states[e], measured[e]
        if fresh[e]:
            fresh[e] = False
            for i in range(x.shape[0]):
                x[i] = y[i]
            continue
        for i in range(nu):
            rate[i] = (y[2 * q + i] - x[2 * q + i]) / dt
        step_state(x, rate, dt, model, loads[e], work, after)
        see_late(after, late, model, work, seen)
        for i in range(q):
            off = y[i] - seen[i]
            if 3 <= i and i < 6:
                off = wrap(off)
            x[i] = after[i] + share * off
            x[q + i] = after[q + i] + following / dt * off
        for i in range(nu):
            x[2 * q + i] = y[2 * q + i]


@kernel
def see_late(x, late, model, work, seen):
    """Write what is measured of places (6 + 2 N,) where the payload's pose is that of `late` [s] ago.

    Cables are measured from the payload, too: what an anchor has moved since then is part of the way to its drone.
    """
    count = model.anchors.shape[0]
    q = 6 + 2 * count
    for i in range(q):
        seen[i] = x[i]
    if late == 0.0:
        return
    t = euler_rates(x[3], x[4])
    w0, w1, w2 = x[q + 3], x[q + 4], x[q + 5]
    for i in range(3):
        seen[i] -= late * x[q + i]
    seen[3] -= late * (w0 + t[0] * w1 + t[1] * w2)
    seen[4] -= late * (t[2] * w1 + t[3] * w2)
    seen[5] -= late * (t[4] * w1 + t[5] * w2)
    set_rotation(x, work.rotation, work.turning)
    r = work.rotation
    for n in range(count):
        turning = cross((w0, w1, w2), row(model.anchors, n))
        speed = add(
            (x[q], x[q + 1], x[q + 2]), (dot(row(r, 0), turning), dot(row(r, 1), turning), dot(row(r, 2), turning))
        )
        cx, cy = x[6 + 2 * n], x[7 + 2 * n]
        way = add(scale(model.length[n], (cx, cy, sqrt(max(1.0 - cx * cx - cy * cy, 0.0)))), scale(late, speed))
        seen[6 + 2 * n], seen[7 + 2 * n] = way[0] / norm(way), way[1] / norm(way)
