"""States of teams from noisy and late measurements, by the reduced model: an alpha-beta filter about its prediction.

Filters of sensors know no thrusts, so what they say of velocities is late where a payload accelerates. The model does:
places are corrected by a share of what is measured beside the prediction, velocities by what this asks for (Kalata,
IEEE TAES 20(2), 1984). Thrust vectors are taken as measured.
"""

from __future__ import annotations

import numpy as np

from multilift_marl.control.formation import wrap
from multilift_marl.kernels.jit import kernel
from multilift_marl.planning.team_model import ModelWork, TeamModel, step_state


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

    def update(self, measured: np.ndarray, dt: float, loads: np.ndarray) -> np.ndarray:
        """Return the states, live, by what is measured (E, 12 + 7 N) `dt` [s] after the last, under loads (E, 7)."""
        own = self.states, self.fresh
        _update(measured, dt, loads, own, self._model, self._gains, (self._work, self._after, self._rate))
        return self.states


@kernel
def _update(measured, dt, loads, own, model, gains, arrays):
    states, fresh = own
    share, following, late = gains
    work, after, rate = arrays
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
        for i in range(q):
            seen = after[i] - (late * after[q + i] if i < 3 else 0.0)
            off = y[i] - seen
            if 3 <= i and i < 6:
                off = wrap(off)
            x[i] = after[i] + share * off
            x[q + i] = after[q + i] + following / dt * off
        for i in range(nu):
            x[2 * q + i] = y[2 * q + i]
