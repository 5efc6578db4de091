"""How chains move, with the bodies that they tie together: substeps that conserve momentum.

In a substep springs and dampers are implicit along the links (`chain_solver.py`), and forces on nodes and bodies are
equal, opposite and in one line. Every place then advances with its new velocity. For stiff links this is SHAKE
(Ryckaert, Ciccotti and Berendsen 1977), a symplectic method: linear and angular momentum of payload, nodes and drones
change by loads alone, to round-off, and energy does not drift.

The effect of a tension across its link is explicit, and stable while T h² < m l. The substep is halved until that holds
with a margin, so a cable may snatch at any speed. Bending is explicit too.
"""

from __future__ import annotations

from math import atan2

from multilift_marl.kernels.jit import kernel
from multilift_marl.math3d import (
    IDENTITY,
    add,
    axis_angle,
    cross,
    dot,
    matmul,
    matrow,
    mul,
    norm,
    put,
    putmat,
    row,
    scale,
    sub,
    tmul,
    unit,
)
from multilift_marl.physical import GRAVITY
from multilift_marl.sim.cables.chain_arrays import UNITS
from multilift_marl.sim.cables.chain_solver import (
    add_turning,
    factorize,
    find_links,
    node_velocity,
    solve_tensions,
    steepness,
    stretch_gain,
)
from multilift_marl.sim.state_io import body_dof

_MARGIN = 0.3  # [-] T h²/(m l) of a substep that may be taken


@kernel
def advance_chains(rows, data, chain, work):
    """Advance nodes and bodies by one physics step, and load MuJoCo's bodies with the cables.

    Args:
        rows: Rows of the environments, with the loads of the step; the cables' mean forces are added.
        data: SimData at the start of the step; `cable_broken` is written.
        chain: Chain; nodes and motion are written.
        work: Workspace.
    """
    state = data.state
    motion = chain.motion
    for i in range(rows.state.shape[0]):
        e = rows.first + i
        if data.diverged[e]:
            continue
        for n in range(chain.segments.shape[0]):
            motion.first_broken[e, n] = state.cable_broken[e, n]
            for j in range(chain.segments[n] - 1):
                put(motion.first_position[e, n, j], row(chain.nodes.position[e, n], j))
                put(motion.first_velocity[e, n, j], row(chain.nodes.velocity[e, n], j))
        gather_bodies(e, rows.state[i], state, chain, rows, work)
        take_substeps(e, state, chain, work)
        add_cables(e, rows.state[i], 1.0, chain, rows)


@kernel
def take_substeps(e, state, chain, work):
    """Advance nodes and bodies in substeps, each halved until it is stable, and doubled where the next one would be."""
    motion = chain.motion
    timestep = chain.cables.timestep
    motion.dissipated[e] = 0.0
    for n in range(chain.segments.shape[0]):
        motion.peak[e, n] = 0.0
    left = UNITS
    size = chain.largest[e]
    while left > 0:
        size = min(size, left)
        if chain.bends:
            _find_bending(e, state, chain, work)
        while True:
            h = size * timestep / UNITS
            find_links(e, h, state, chain, work)
            factorize(e, state, chain, work)
            solve_tensions(e, h, state, chain, work)
            # At a 1024th of a step the cable is taken as it is: MAX_SPEED and MAX_STRETCH find what is beyond that.
            if size == 1 or steepness(e, h, chain, work) <= _MARGIN:
                break
            size //= 2
        # Only for the substep that is taken: it is a correction, and halving needs no more than T.
        add_turning(e, h, state, chain, work)
        _move(e, h, state, chain, work)
        left -= size
        if size < chain.largest[e] and steepness(e, 2.0 * h, chain, work) < _MARGIN:
            size *= 2


@kernel
def add_cables(e, line, sign, chain, rows):
    """Add the cables' mean forces in the physics step to the loads of MuJoCo's bodies; sign -1 takes them off."""
    motion = chain.motion
    for b in range(motion.position.shape[1]):
        at = rows.force + body_dof(b, rows)
        for j in range(6 if b > 0 or rows.payload_nv == 6 else 3):
            # The step's impulse over its length: MuJoCo moves its bodies by the same momentum, in one step.
            line[at + j] += sign * motion.impulse[e, b, j] / chain.cables.timestep


@kernel
def gather_bodies(e, line, state, chain, rows, work):
    """Take the bodies at the start of a physics step and the forces on them: gravity, loads, lasting contact.

    Contact is there so that cables do not have to hold for a moment what rests on the ground: as much of it as the
    last two steps had in common, since the impulse of an impact is over.
    """
    bodies = chain.bodies
    motion = chain.motion
    for b in range(motion.position.shape[1]):
        # Motion of the centre of mass. A point payload does not turn.
        turns = b > 0 or rows.payload_nv == 6
        if b == 0:
            position = row(state.payload_position, e)
            velocity = row(state.payload_velocity, e)
            attitude = matrow(state.payload_rotation, e) if turns else IDENTITY
            rates = row(state.payload_body_rates, e) if turns else (0.0, 0.0, 0.0)
        else:
            position = row(state.drone_position[e], b - 1)
            velocity = row(state.drone_velocity[e], b - 1)
            attitude = matrow(state.drone_rotation[e], b - 1)
            rates = row(state.drone_body_rates[e], b - 1)
        center = row(bodies.center[e], b)
        put(motion.position[e, b], add(position, mul(attitude, center)))
        # Of the centre of mass, about which bodies turn: v + R (Ω × c). `chain_contact` goes back at the end of the
        # step.
        put(motion.velocity[e, b], add(velocity, mul(attitude, cross(rates, center))))
        put(motion.rates[e, b], rates)
        putmat(motion.rotation[e, b], attitude)
        put(work.momentum[b], mul(attitude, mul(matrow(bodies.inertia[e], b), rates)))

        # Force and torque about the centre of mass.
        at = rows.force + body_dof(b, rows)
        touch = chain.nodes.contact[e, b]
        force = (line[at], line[at + 1], line[at + 2])
        force = add(force, (common_force(touch, 0), common_force(touch, 1), common_force(touch, 2)))
        put(work.force[b], sub(force, (0.0, 0.0, bodies.mass[e, b] * GRAVITY)))
        if turns:
            torque = (line[at + 3], line[at + 4], line[at + 5])
            torque = add(torque, (common_force(touch, 3), common_force(touch, 4), common_force(touch, 5)))
            # About the centre of mass: what the loads' force exerts about the origin is taken off. Gravity has no
            # moment there.
            put(work.torque[b], sub(torque, cross(center, tmul(attitude, force))))
        for j in range(6):
            motion.impulse[e, b, j] = 0.0


@kernel
def common_force(touch, j):
    """Return the smaller one of a contact's two last values, 0 where their signs differ."""
    last = touch[0, j]
    before = touch[1, j]
    if last * before <= 0.0:
        return 0.0
    return last if abs(last) < abs(before) else before


@kernel
def _move(e, h, state, chain, work):
    """Give nodes and bodies the velocities that follow from the tensions, and move them."""
    bodies = chain.bodies
    motion = chain.motion
    nodes = chain.nodes
    # Bodies without cables, and bending.
    motion.dissipated[e] += h * work.bend_power[0]
    for b in range(motion.position.shape[1]):
        put(motion.velocity[e, b], row(work.free_velocity, b))
        torque = add(mul(matrow(motion.rotation[e], b), row(work.torque, b)), row(work.bend_moment, b))
        put(work.momentum[b], add(row(work.momentum, b), scale(h, torque)))
        if chain.bends:
            _add_impulse(e, b, scale(h, row(work.bend_force, b)), scale(h, row(work.bend_moment, b)), chain)

    for n in range(chain.segments.shape[0]):
        # Energy that the dampers along the links take: their rate of stretch follows from the implicit law.
        links = chain.segments[n]
        c = chain.damping[n]
        gain = stretch_gain(chain.stiffness[e, n], c, h)
        for j in range(links - (1 if state.cable_broken[e, n] else 0)):
            # From T = steady + g rate. A link between a broken cable's last node and the drone has neither tension nor
            # damper.
            rate = (work.tension[n, j] - work.steady[n, j]) / gain
            motion.dissipated[e] += h * c * rate * rate

        # Nodes.
        for j in range(links - 1):
            velocity = node_velocity(e, n, j, h, chain, work)
            put(nodes.velocity[e, n, j], velocity)
            put(nodes.position[e, n, j], add(row(nodes.position[e, n], j), scale(h, velocity)))

        # Impulses on payload and drone. The cable breaks beside its drone.
        top = links - 1
        first = scale(h * work.tension[n, 0], row(work.direction[n], 0))
        last = scale(-h * work.tension[n, top], row(work.direction[n], top))
        _push(e, 0, first, row(work.ends[n], 0), chain, work)
        _push(e, 1 + n, last, row(work.ends[n], 1), chain, work)
        tension = max(0.0, work.tension[n, top])
        motion.tension[e, n] = tension
        motion.peak[e, n] = max(motion.peak[e, n], tension)
        if tension > chain.cables.breaking_load[n]:
            state.cable_broken[e, n] = True

    # Places of the bodies. The attitude follows the momentum by the midpoint rule.
    for b in range(motion.position.shape[1]):
        put(motion.position[e, b], add(row(motion.position[e], b), scale(h, row(motion.velocity[e], b))))
        # A point payload has no inertia, and 0 for its inverse.
        if bodies.inverse[e, b, 0, 0] > 0.0:
            attitude = matrow(motion.rotation[e], b)
            inverse = matrow(bodies.inverse[e], b)
            momentum = row(work.momentum, b)
            rates = mul(inverse, tmul(attitude, momentum))
            # The momentum L stays in the world frame. Rates of the middle: by the attitude half a substep on.
            rates = mul(inverse, tmul(turned(attitude, scale(0.5 * h, rates)), momentum))
            attitude = turned(attitude, scale(h, rates))
            putmat(motion.rotation[e, b], attitude)
            put(motion.rates[e, b], mul(inverse, tmul(attitude, momentum)))


@kernel
def _push(e, b, impulse, arm, chain, work):
    """Give body b an impulse [N s] at `arm` from its centre of mass, world frame."""
    velocity = chain.motion.velocity[e, b]
    moment = cross(arm, impulse)
    put(velocity, add((velocity[0], velocity[1], velocity[2]), scale(1.0 / chain.bodies.mass[e, b], impulse)))
    put(work.momentum[b], add(row(work.momentum, b), moment))
    _add_impulse(e, b, impulse, moment, chain)


@kernel
def _add_impulse(e, b, impulse, moment, chain):
    """Add an impulse and its moment about the centre of mass to those that are applied to MuJoCo's body."""
    attitude = matrow(chain.motion.rotation[e], b)
    turning = add(tmul(attitude, moment), cross(row(chain.bodies.center[e], b), tmul(attitude, impulse)))
    for j in range(3):
        chain.motion.impulse[e, b, j] += impulse[j]
        chain.motion.impulse[e, b, 3 + j] += turning[j]


@kernel
def turned(attitude, vector):
    """Return an attitude turned by a rotation vector in the body frame."""
    return matmul(attitude, axis_angle(unit(vector), norm(vector)))


@kernel
def _find_bending(e, state, chain, work):
    """Find the forces of bending on nodes and bodies: of the moment κ θ + β θ̇ at the angle θ between two links.

    The forces on the three points of a bend are the moment times the derivatives of θ by their places. They have
    neither a sum nor a moment. Anchor and hook are free pivots.
    """
    motion = chain.motion
    nodes = chain.nodes
    work.bend_power[0] = 0.0
    work.bend_force[:] = 0.0
    work.bend_moment[:] = 0.0
    work.bending[:] = 0.0
    payload = matrow(motion.rotation[e], 0)
    for n in range(chain.segments.shape[0]):
        links = chain.segments[n]
        arm = mul(payload, sub(row(chain.cables.anchors, n), row(chain.bodies.center[e], 0)))
        low, low_velocity = _body_point(e, 0, arm, motion)
        middle = row(nodes.position[e, n], 0)
        middle_velocity = row(nodes.velocity[e, n], 0)
        for j in range(links - 1):
            # The three points of the bend: the last of them is a node or the hook.
            if j < links - 2:
                high = row(nodes.position[e, n], j + 1)
                high_velocity = row(nodes.velocity[e, n], j + 1)
            elif state.cable_broken[e, n]:
                break
            else:
                hook = mul(matrow(motion.rotation[e], 1 + n), row(chain.cables.hooks, n))
                high, high_velocity = _body_point(e, 1 + n, hook, motion)
            first = sub(middle, low)
            second = sub(high, middle)
            size1 = norm(first)
            size2 = norm(second)
            d1 = scale(1.0 / size1, first)
            d2 = scale(1.0 / size2, second)
            sine = norm(cross(d1, d2))
            cosine = dot(d1, d2)
            # A straight bend has no plane and no moment. Nor has one that is folded flat, where its moment has no
            # direction.
            if sine > 1e-9:
                # The angle shrinks as d1 moves along e1 and d2 along e2, unit vectors across the links in the bend.
                e1 = scale(1.0 / (sine * size1), sub(d2, scale(cosine, d1)))
                e2 = scale(1.0 / (sine * size2), sub(d1, scale(cosine, d2)))
                closing = dot(e1, sub(middle_velocity, low_velocity)) + dot(e2, sub(high_velocity, middle_velocity))
                # closing = -θ̇: hence the moment κ θ + β θ̇ = κ θ - β closing.
                work.bend_power[0] += chain.bending_damping[n] * closing * closing
                moment = chain.bending_stiffness[n] * atan2(sine, cosine) - chain.bending_damping[n] * closing
                on_low = scale(-moment, e1)
                on_high = scale(moment, e2)
                # The three forces add up to zero, and so do their moments: bending leaves both momenta as they are.
                on_middle = sub((0.0, 0.0, 0.0), add(on_low, on_high))
                # On nodes, and on the bodies at the cable's ends.
                put(work.bending[n, j], add(row(work.bending[n], j), on_middle))
                if j > 0:
                    put(work.bending[n, j - 1], add(row(work.bending[n], j - 1), on_low))
                else:
                    put(work.bend_force[0], add(row(work.bend_force, 0), on_low))
                    put(work.bend_moment[0], add(row(work.bend_moment, 0), cross(arm, on_low)))
                if j < links - 2:
                    put(work.bending[n, j + 1], add(row(work.bending[n], j + 1), on_high))
                else:
                    put(work.bend_force[1 + n], on_high)
                    put(work.bend_moment[1 + n], cross(hook, on_high))
            low = middle
            low_velocity = middle_velocity
            middle = high
            middle_velocity = high_velocity


@kernel
def _body_point(e, b, arm, motion):
    """Return place and velocity of a point of body b, `arm` from its centre of mass in the world frame."""
    rates = mul(matrow(motion.rotation[e], b), row(motion.rates[e], b))
    return add(row(motion.position[e], b), arm), add(row(motion.velocity[e], b), cross(rates, arm))
