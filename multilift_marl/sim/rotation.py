"""How bodies turn in a physics step: the midpoint rule, by a torque that corrects MuJoCo's.

In a step h MuJoCo takes the gyroscopic torque Ω × JΩ of a body that a cable holds at its start, and of a free one with
its linear change as well ("Gyroscopic derivatives for free bodies" in its computation chapter), which is backward
Euler: it takes 10 % of the energy of a body at 20 rad/s within a second at 4 ms. The midpoint rule

    J (Ω' - Ω) = h (τ - Ω̄ × JΩ̄),   Ω̄ = (Ω + Ω')/2

keeps the body's energy and the size of its angular momentum where there is no torque τ (Austin, Krishnaprasad and Wang,
J. Comput. Phys. 107, 1993). What MuJoCo's step lacks of it is added to the torques of the loads. The torque of a taut
cable is not known before the step, and at rest it balances the rotors' about a hook: for a body that is held, Ω̄ is that
of its gyroscopic torque alone. Chains have a midpoint rule of their own (`chain_dynamics.py`).
"""

from __future__ import annotations

from multilift_marl.kernels.jit import kernel
from multilift_marl.math3d import IDENTITY, add, cross, dot, mat, matrow, mul, put, row, scale, sub, tmul, vec
from multilift_marl.sim.state_io import body_dof

_FASTEST = 2.0  # [rad] of turning in a step, above which the passes do not settle and MuJoCo's own step is kept
_PASSES = 3  # over the implicit rule: of the energy, (h Ω)⁴/4 is missing then in a step


@kernel
def add_gyroscopic(rows, data, cables):
    """Add to the loads of a step what MuJoCo's step lacks of the midpoint rule.

    Args:
        rows: Rows of the environments, with the loads of the step; torques are added to.
        data: SimData at the start of the step.
        cables: MasslessCables; `gyroscopic` is written.
    """
    state = data.state
    bodies = cables.bodies
    common = cables.cables
    h = common.timestep
    for i in range(rows.state.shape[0]):
        e = rows.first + i
        line = rows.state[i]
        turns = rows.payload_nv == 6
        payload = matrow(state.payload_rotation, e) if turns else IDENTITY
        held = False

        # Drones, which their cables hold where the ends are farther apart than the cable is long.
        for n in range(common.hooks.shape[0]):
            taut = False
            if not state.cable_broken[e, n]:
                low = add(row(state.payload_position, e), mul(payload, row(common.anchors, n)))
                high = add(vec(state.drone_position, e, n), mul(mat(state.drone_rotation, e, n), row(common.hooks, n)))
                cable = sub(high, low)
                # By squares of lengths: no root for each cable in each step.
                taut = dot(cable, cable) > common.length[e, n] * common.length[e, n]
            held = held or taut
            f = rows.force + body_dof(1 + n, rows) + 3
            v = rows.qvel + body_dof(1 + n, rows) + 3
            rates = (line[v], line[v + 1], line[v + 2])
            torque = (line[f], line[f + 1], line[f + 2])
            inertia = matrow(bodies.inertia[e], 1 + n)
            alone = not (taut or _may_touch(e, 1 + n, state, cables.radii))
            # A drone's frame begins at its centre of mass: its loads need no shift.
            lacking = midpoint_torque(rates, torque, inertia, matrow(bodies.inverse[e], 1 + n), h, taut, alone)
            put(cables.gyroscopic[e, 1 + n], lacking)
            put(line[f : f + 3], add(torque, lacking))

        # The payload, which any of the cables holds. Loads are about the origin of its frame.
        if turns:
            f = rows.force
            v = rows.qvel + 3
            rates = (line[v], line[v + 1], line[v + 2])
            torque = (line[f + 3], line[f + 4], line[f + 5])
            # τ about the centre of mass c is τ about the origin less c × F, the force brought from the world to the
            # body frame.
            own = sub(torque, cross(row(bodies.center[e], 0), tmul(payload, (line[f], line[f + 1], line[f + 2]))))
            alone = not (held or _may_touch(e, 0, state, cables.radii))
            inverse = matrow(bodies.inverse[e], 0)
            lacking = midpoint_torque(rates, own, matrow(bodies.inertia[e], 0), inverse, h, held, alone)
            put(cables.gyroscopic[e, 0], lacking)
            put(line[f + 3 : f + 6], add(torque, lacking))


@kernel
def midpoint_torque(rates, torque, inertia, inverse, h, held, alone):
    """Return the torque that makes MuJoCo's step of a body one of the midpoint rule, body frame [N m].

    Args:
        rates: body rates at the start of the step [rad/s].
        torque: on the body, about its centre of mass, body frame [N m]; taken to be balanced where a cable holds it.
        inertia, inverse: J [kg m²] and its inverse, 9 numbers each.
        h: [s].
        held: whether a cable holds the body.
        alone: whether neither a cable nor contact acts on it: MuJoCo then has the linear change, too.
    """
    if h * h * dot(rates, rates) > _FASTEST * _FASTEST:
        return (0.0, 0.0, 0.0)

    # The change of the body rates, from the gyroscopic torque at the midpoint.
    if held:
        torque = (0.0, 0.0, 0.0)
    momentum = mul(inertia, rates)
    start = cross(rates, momentum)
    middle = start
    change = scale(h, mul(inverse, sub(torque, start)))
    # Fixed-point passes, which converge the faster the less the body turns in a step: hence the bound above.
    for _ in range(_PASSES - 1):
        mean = add(rates, scale(0.5, change))
        middle = cross(mean, mul(inertia, mean))
        change = scale(h, mul(inverse, sub(torque, middle)))

    # In place of it MuJoCo has that of the start, and with free bodies its linear change.
    # MuJoCo solves J ΔΩ = h (τ + this - start): with this = start - middle its ΔΩ is that of the midpoint rule.
    if not alone:
        return sub(start, middle)
    # With the linear change D ΔΩ = ΔΩ × JΩ + Ω × JΔΩ it solves (J + h D) ΔΩ = h (τ + this - start): D ΔΩ is added, or
    # it would be damped away.
    turned = add(cross(change, momentum), cross(rates, mul(inertia, change)))
    return add(sub(start, middle), turned)


@kernel
def _may_touch(e, b, state, radii):
    """Return whether the sphere about body b reaches the ground or that about another, so that contact may act."""
    here = row(state.payload_position, e) if b == 0 else vec(state.drone_position, e, b - 1)
    if here[2] < radii[b]:
        return True
    for j in range(radii.shape[0]):
        if j != b:
            away = sub(here, row(state.payload_position, e) if j == 0 else vec(state.drone_position, e, j - 1))
            reach = radii[b] + radii[j]
            if dot(away, away) < reach * reach:
                return True
    return False
