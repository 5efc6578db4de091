"""The planner's problem for IPOPT, anew from Newton's laws: accelerations and tensions are unknowns of each step.

CasADi differentiates it; nothing is shared with the solver but the numbers of the team, its costs and limits.
"""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from multilift_marl.physical import GRAVITY
from multilift_marl.planning.expert import Solution, TeamExpert


class Oracle:
    """The plans of one team by IPOPT, for a target that stays.

    Args:
        expert: whose model, costs and limits count.
        target: (12 + 7 N,) state.
    """

    def __init__(self, expert: TeamExpert, target: np.ndarray):
        model, objective = expert.model, expert.objective
        n, steps, h = len(model.anchors), len(expert.times) - 1, float(expert.times[1, 2] - expert.times[0, 2])
        size, q = 12 + 7 * n, 6 + 2 * n
        start, here = ca.MX.sym("start", size), None
        x, u, law = ca.SX.sym("x", size), ca.SX.sym("u", 3 * n), ca.SX.sym("law", q + n)
        step = ca.Function("step", [x, u, law], self._step(x, u, law, model, h, q))
        node = ca.Function("node", [x], [self._limits(x, expert.limits, model)])
        cost, unknowns, first, constraints, lowest = 0.0, [], [], [], []
        here = start
        for k in range(steps):
            rate, laws, after = ca.MX.sym(f"u{k}", 3 * n), ca.MX.sym(f"a{k}", q + n), ca.MX.sym(f"x{k}", size)
            off = here - target
            cost += 0.5 * h * (ca.dot(objective.state * off, off) + ca.dot(objective.rate * rate, rate))
            end, residual = step(here, rate, laws)
            tension = (laws[q:] - expert.limits.tension) / expert.limits.tolerance[0]
            constraints += [after - end, residual, tension, node(after)]
            lowest += [np.zeros(size), np.zeros(q + n), np.zeros(n), np.zeros(node.size1_out(0))]
            unknowns += [rate, laws, after]
            pull = np.linalg.norm(target[-3 * n :].reshape(n, 3) - model.drone_mass[:, None] * [0, 0, GRAVITY], axis=1)
            first += [np.zeros(3 * n), np.zeros(q), pull, target]
            here = after
        off = here - target
        cost += 0.5 * ca.dot(objective.end * off, off)
        free = size + q + n
        bounds = [np.r_[np.zeros(free), np.full(n + node.size1_out(0), np.inf)]] * steps
        self._bounds = {"lbg": np.concatenate(lowest), "ubg": np.concatenate(bounds)}
        self._first = np.concatenate(first)
        problem = {"x": ca.vertcat(*unknowns), "f": cost, "g": ca.vertcat(*constraints), "p": start}
        cold = {"print_level": 0, "sb": "yes", "tol": 1e-9, "max_iter": 500}
        warm = cold | {"mu_init": 1e-7, "bound_push": 1e-8, "bound_frac": 1e-8}
        self._cold, self._warm = (
            ca.nlpsol("oracle", "ipopt", problem, {"print_time": False, "ipopt": options}) for options in (cold, warm)
        )
        self._expert, self._shape, self._step_length = expert, (steps, 3 * n, q + n, size), h

    def solve(self, start: np.ndarray) -> tuple[float, bool]:
        """Return the cost of the plan from a state, and whether IPOPT converged; it begins at the target."""
        found = self._cold(x0=self._first, p=start, **self._bounds)
        return float(found["f"]), bool(self._cold.stats()["success"])

    def stay(self, plans: Solution, e: int) -> tuple[float, bool]:
        """Do as `solve` from the start of plan e, beginning with this plan."""
        steps, nu, _, size = self._shape
        states, n, limits = plans.states[e], nu // 3, self._expert.limits
        speeds = states[:, 6 + 2 * n : 12 + 4 * n]
        first = self._first.reshape(steps, -1).copy()
        first[:, :nu], first[:, -size:] = plans.inputs[e], states[1:]
        first[:, nu : nu + 6 + 2 * n] = np.diff(speeds, axis=0) / self._step_length
        first[:, nu + 6 + 2 * n : -size] = limits.tension + limits.tolerance[0] * plans.margins[e, :, :n]
        found = self._warm(x0=first.ravel(), p=states[0], **self._bounds)
        return float(found["f"]), bool(self._warm.stats()["success"])

    @staticmethod
    def _turn(e: Any) -> Any:
        cr, sr, cp, sp, cy, sy = ca.cos(e[0]), ca.sin(e[0]), ca.cos(e[1]), ca.sin(e[1]), ca.cos(e[2]), ca.sin(e[2])
        about_z = ca.vertcat(ca.horzcat(cy, -sy, 0), ca.horzcat(sy, cy, 0), ca.horzcat(0, 0, 1))
        about_y = ca.vertcat(ca.horzcat(cp, 0, sp), ca.horzcat(0, 1, 0), ca.horzcat(-sp, 0, cp))
        about_x = ca.vertcat(ca.horzcat(1, 0, 0), ca.horzcat(0, cr, -sr), ca.horzcat(0, sr, cr))
        return about_z @ about_y @ about_x

    @staticmethod
    def _euler_rates(e: Any, w: Any) -> Any:
        """Return the rates of roll, pitch and yaw: ω is the sum of what each contributes in the payload's frame."""
        cr, sr, cp, sp = ca.cos(e[0]), ca.sin(e[0]), ca.cos(e[1]), ca.sin(e[1])
        by_rates = ca.vertcat(ca.horzcat(1, 0, -sp), ca.horzcat(0, cr, sr * cp), ca.horzcat(0, -sr, cr * cp))
        return ca.solve(by_rates, w)

    def _step(self, x: Any, u: Any, law: Any, model: Any, h: float, q: int) -> list[Any]:
        """Return the state after a step, and the laws of payload and drones in its middle."""
        n = len(model.anchors)
        rate = ca.vertcat(x[q : q + 3], self._euler_rates(x[3:6], x[q + 3 : q + 6]), x[q + 6 : 2 * q])
        place, thrust = x[:q] + 0.5 * h * rate, x[2 * q :] + 0.5 * h * u
        velocity, w, a, spin = x[q : q + 3], x[q + 3 : q + 6], law[:3], law[3:6]
        turn, up = self._turn(place[3:6]), ca.DM([0, 0, 1])
        force = -model.payload_mass * GRAVITY * up - model.drag * ca.sqrt(ca.sumsqr(velocity) + 1e-6) * velocity
        moment, laws = ca.SX.zeros(3), []
        for i in range(n):
            c, e, b = place[6 + 2 * i : 8 + 2 * i], x[q + 6 + 2 * i : q + 8 + 2 * i], law[6 + 2 * i : 8 + 2 * i]
            z = ca.sqrt(ca.fmax(1 - ca.sumsqr(c), 0.01))
            bent = -(ca.sumsqr(e) + ca.dot(c, b)) / z - ca.dot(c, e) ** 2 / z**3
            d, arm, pull = ca.vertcat(c, z), model.anchors[i], law[q + i]
            anchor = a + turn @ (ca.cross(spin, arm) + ca.cross(w, ca.cross(w, arm)))
            mass = model.drone_mass[i]
            moved = mass * (anchor + model.length[i] * ca.vertcat(b, bent))
            laws.append(moved - thrust[3 * i : 3 * i + 3] + mass * GRAVITY * up + pull * d)
            force += pull * d
            moment += ca.cross(arm, turn.T @ (pull * d))
        laws.append(model.payload_mass * a - force)
        laws.append(model.inertia @ spin + ca.cross(w, model.inertia @ w) - moment)
        swift = x[q : 2 * q] + 0.5 * h * law[:q]
        way = ca.vertcat(swift[:3], self._euler_rates(x[3:6], swift[3:6]), swift[6:])
        after = ca.vertcat(x[:q] + h * way, x[q : 2 * q] + h * law[:q], x[2 * q :] + h * u)
        return [after, ca.vertcat(*laws)]

    def _limits(self, x: Any, limits: Any, model: Any) -> Any:
        """Return the limits of a state in their tolerances."""
        n = len(model.anchors)
        q, turn = 6 + 2 * n, self._turn(x[3:6])
        feet, places, values = [], [], []
        for i in range(n):
            c, f = x[6 + 2 * i : 8 + 2 * i], x[2 * q + 3 * i : 2 * q + 3 * i + 3]
            thrust = ca.norm_2(f)
            unit = limits.tolerance[1]
            values += [(limits.largest[i] - thrust) / unit, (thrust - limits.least[i]) / unit]
            values.append((f[2] - limits.upright * thrust) / unit)
            d = ca.vertcat(c, ca.sqrt(ca.fmax(1 - ca.sumsqr(c), 0.01)))
            feet.append(turn @ model.anchors[i])
            places.append(feet[i] + model.length[i] * d)
            for o in range(i):
                away = ca.norm_2(places[i] - places[o])
                values.append((away - limits.separation[i, o]) / limits.tolerance[2])
                apart = self._apart(feet[i], places[i] - feet[i], feet[o], places[o] - feet[o])
                values.append((apart - limits.cables[i, o]) / limits.tolerance[3])
        return ca.vertcat(*values)

    @staticmethod
    def _apart(p: Any, a: Any, r: Any, b: Any) -> Any:
        """Return the distance of two segments that are not parallel, from p along a and from r along b."""
        aa, bb, ab, pa, pb = ca.dot(a, a), ca.dot(b, b), ca.dot(a, b), ca.dot(p - r, a), ca.dot(p - r, b)
        s = ca.fmin(ca.fmax((ab * pb - pa * bb) / (aa * bb - ab**2 + 1e-12), 0), 1)
        t = ca.fmin(ca.fmax((ab * s + pb) / bb, 0), 1)
        s = ca.fmin(ca.fmax((ab * t - pa) / aa, 0), 1)
        return ca.norm_2(p + s * a - r - t * b)
