"""The cable forces that hold a payload level, and how cables lean at rest."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from multilift_marl.errors import RigError

_LEAST_PULL = 0.02  # [-] of its share of the weight that every cable holds
_LEAST_SHARE = 0.05  # [-] of the same, where shares are bounded
_FLATTEST = np.tan(np.deg2rad(80))  # of a cable at rest; cable.angle is less
_HELD = np.deg2rad(0.2)  # by which cables may lean otherwise than is held, for angles given with few digits
_LEAST_LEAN = 0.1  # [-] of `cable.angle`, which cables with an azimuth come near to
_NEWTON_STEPS = 50
_EXACT = 1e4  # [-] weight of the balance beside that of the distance, whose square is the error that it leaves


def formation_forces(
    anchors: np.ndarray, weight: float, angle: float | np.ndarray, point: bool, strength: np.ndarray,
    azimuth: np.ndarray | None = None,
) -> np.ndarray:  # fmt: skip
    """Return the cable forces (N, 3) [N] that hold a payload level, as near as possible to `angle` from the vertical.

    The forces nearest to those in proportion to the drones' strength, each measured by its own, in the least-squares
    sense among all that balance the weight and its moments about the centre of mass. Where a cable would push, or lie
    flatter than any formation, shares of the weight are found first that no cable may fall short of: the nearest to
    those of strength among all that balance the load's place between the anchors. The forces then are the nearest to
    cables at `angle` with these shares, each measured by its own, so that a cable that carries little is not tilted.

    Args:
        anchors: (N, 3) [m] from the centre of mass.
        weight: of the payload [N].
        angle: of the cables from the vertical [rad]; one number is approached, one for each (N,) is held.
        point: True where the payload has no attitude to hold.
        strength: of each drone, relative to the mean (N,) [-].
        azimuth: direction in which each cable leans (N,) [rad], held; None: near that away from the anchors' middle.

    Raises:
        RigError: no forces balance the payload, some cable would have to push, or no cables that lean as is to be held
            balance it.
    """
    n = len(anchors)
    share = weight / n * strength
    pulling = []
    # First what was asked for, then shares with lower bounds, where a cable would push or lie flat.
    for shares, measure in _tried_shares(anchors, weight, point, share, strength, angle, azimuth):
        force = _balanced_forces(anchors, weight, angle, point, shares, measure, azimuth)
        if _all_pull(force, share):
            if _is_held(force, angle, azimuth):
                return force
            pulling.append(force)
    # With all directions free: this tells anchors that hold no payload from angles that hold none.
    free = [
        _balanced_forces(anchors, weight, float(np.mean(angle)), point, *tried, None)
        for tried in _tried_shares(anchors, weight, point, share, strength, angle, None)
    ]
    pulling += [force for force in free if _all_pull(force, share)]
    if not pulling:
        pushing = int((free[0][:, 2] / strength).argmin())
        raise RigError(
            f"payload.anchors: cable {pushing} would have to push; move the anchors around the centre of mass",
            drones=[pushing], anchors=[pushing],
        )  # fmt: skip
    # Rather one whose cables lean out at all, so that the message does not propose upright ones.
    leaning = [force for force in pulling if (_lean(force)[0] >= _LEAST_LEAN * np.asarray(angle)).all()]
    nearest = min(leaning or pulling, key=lambda force: _astray(force, angle, azimuth))
    # 0.0 added makes 0.0 of -0.0.
    lean, towards = ((np.round(np.rad2deg(each), 2) + 0.0).tolist() for each in _lean(nearest))
    raise RigError(
        "cables that lean as cable.angle and cable.azimuth say cannot hold the payload level, whatever their tensions; "
        f"the nearest that can have cable.angle={lean} and cable.azimuth={towards}",
        drones=range(n),
    )


def _tried_shares(
    anchors: np.ndarray, weight: float, point: bool, share: np.ndarray, strength: np.ndarray,
    angle: float | np.ndarray, azimuth: np.ndarray | None,
) -> Iterator[tuple[np.ndarray, np.ndarray]]:  # fmt: skip
    """Yield shares of the weight (N,) [N] and by what the deviation of each cable counts (N,) [-], in order."""
    yield share, strength
    # RMS distance of the anchors from the vertical axis: moments over it count as forces do.
    lever = np.sqrt((anchors[:, :2] ** 2).sum(axis=1).mean()) or 1.0
    upright = [np.ones(len(anchors)), anchors[:, 0] / lever, anchors[:, 1] / lever]
    balances = [] if point else [np.stack(upright)]
    if azimuth is not None and np.ndim(angle):  # the directions of all cables are held: what is left are their tensions
        slope = np.tan(angle)
        # For each newton that a cable lifts, its force along the direction that is held; the lift goes to the first
        # row.
        pull = np.stack([slope * np.cos(azimuth), slope * np.sin(azimuth), np.ones(len(anchors))], axis=1)
        moments = np.cross(anchors, pull).T / lever
        balances.append(np.concatenate([pull.T[[2, 0, 1]], moments[: 0 if point else 3]]))
    for balance in balances:
        bounded = _bounded_shares(balance, weight, share)
        if bounded is not None:
            yield bounded, bounded * len(anchors) / weight


def nominal_forces(
    anchors: np.ndarray, share: np.ndarray, angle: float | np.ndarray, azimuth: np.ndarray | None
) -> np.ndarray:
    """Return forces (N, 3) [N] with vertical parts `share` (N,) [N] along cables that lean as asked, balanced or not.

    Args: see `formation_forces`.
    """
    n = len(anchors)
    centre = anchors[:, :2].mean(axis=0)
    radial = anchors[:, :2] - centre
    distance = np.linalg.norm(radial, axis=1, keepdims=True)
    # An anchor in the middle has no way outward: as many even directions as there are drones.
    even = 2 * np.pi * np.arange(n) / n
    radial = np.where(
        distance > 1e-6, radial / np.maximum(distance, 1e-6), np.stack([np.cos(even), np.sin(even)], axis=1)
    )
    if azimuth is not None:
        radial = np.stack([np.cos(azimuth), np.sin(azimuth)], axis=1)
    elif n == 1:
        radial = np.zeros((1, 2))
    slope = np.tan(angle)[:, None] if np.ndim(angle) else np.tan(angle)
    return share[:, None] * np.concatenate([slope * radial, np.ones((n, 1))], axis=1)


def _balanced_forces(
    anchors: np.ndarray, weight: float, angle: float | np.ndarray, point: bool, share: np.ndarray,
    measure: np.ndarray, azimuth: np.ndarray | None,
) -> np.ndarray:  # fmt: skip
    """Return the forces (N, 3) [N] nearest to cables at `angle` with vertical parts `share` (N,) [N] that balance.

    Args:
        anchors, weight, angle, point, azimuth: see `formation_forces`.
        share: (N,) [N].
        measure: by which the deviation of each cable counts (N,) [-].
    """
    n = len(anchors)
    balance = np.concatenate([np.eye(3)] * n, axis=1)
    load = np.array([0, 0, weight, 0, 0, 0])
    if point:
        load = load[:3]
    else:
        moments = [[[0, -z, y], [z, 0, -x], [-y, x, 0]] for x, y, z in anchors]
        balance = np.concatenate([balance, np.concatenate(np.array(moments, float), axis=1)], axis=0)
    nominal = nominal_forces(anchors, share, angle, azimuth)
    flat, each = nominal.ravel(), np.repeat(measure, 3)
    if np.ndim(angle) or azimuth is not None:
        flat = _held_forces(nominal, balance, load, angle, azimuth, each)
    # Least Σ |Δf_i / measure_i|²: with Δf = W y it is the least |y| of (B W) y = what is missing.
    force = (flat + each * (np.linalg.pinv(balance * each) @ (load - balance @ flat))).reshape(n, 3)
    # The pseudoinverse solves least squares where nothing balances; what is left of the load shows that.
    residual = np.abs(balance @ force.ravel() - load).max()
    if residual > 1e-6 * weight:
        if n == 1:
            raise RigError(
                f"env.num_drones=1 cannot hold the payload level by an anchor {np.round(anchors[0], 3).tolist()} m "
                "from its centre of mass: raise env.num_drones, or place payload.anchors above the centre of mass",
                anchors=range(n),
            )
        raise RigError(
            f"payload.anchors {np.round(anchors, 3).tolist()} cannot hold the payload level: place them around its "
            "centre of mass",
            anchors=range(n),
        )
    return force


def _held_forces(
    nominal: np.ndarray, balance: np.ndarray, load: np.ndarray, angle: float | np.ndarray,
    azimuth: np.ndarray | None, each: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """Return forces (3 N,) [N] near the nominal ones (N, 3) that balance a load along cables that lean as is held.

    By Newton's method, each step the smallest by `each` (3 N,): with h the level part of a cable's force along its
    azimuth and v the vertical one, a held angle asks for h = v tan(angle), a held azimuth for nothing across it. Where
    no such forces are, the least squares of what is left.
    """
    n, flat = len(nominal), nominal.ravel().copy()
    slope = np.tan(np.broadcast_to(angle, n))
    fixed = np.full(n, azimuth is not None) | (np.ndim(angle) > 0) & (slope == 0)  # an upright cable has no azimuth
    along = np.array([1.0, 0.0]) if azimuth is None else np.stack([np.cos(azimuth), np.sin(azimuth)], axis=1)
    along = np.broadcast_to(along, (n, 2)).copy()
    for _ in range(_NEWTON_STEPS):
        force, rows = flat.reshape(n, 3), []
        level = np.linalg.norm(force[:, :2], axis=1)
        # A free azimuth follows the force from step to step, which is what makes the equations non-linear.
        turns = ~fixed & (level > 0)
        along[turns] = force[turns, :2] / level[turns, None]
        for i in range(n):
            row = np.zeros((2, n, 3))
            row[0, i] = [*along[i], -slope[i]]
            row[1, i] = [-along[i, 1], along[i, 0], 0.0]
            rows += [row[k].ravel() for k, held in enumerate((np.ndim(angle) > 0, fixed[i])) if held]
        wanted = np.concatenate([load, np.zeros(len(rows))])
        system = np.concatenate([balance, np.array(rows)])
        step = each * (np.linalg.pinv(system * each, rcond=1e-9) @ (wanted - system @ flat))
        flat = flat + step
        if np.abs(step).max() < 1e-12 * load[2]:
            break
    return flat


def _lean(force: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return angles from the vertical and azimuths (N,) [rad] of cables that pull with `force` (N, 3) [N]."""
    level = np.hypot(force[:, 0], force[:, 1])
    return np.arctan2(level, force[:, 2]), np.arctan2(force[:, 1], force[:, 0])


def _is_held(force: np.ndarray, angle: float | np.ndarray, azimuth: np.ndarray | None) -> bool:
    """Return whether cables lean as is held, and those whose azimuth is held lean at all where they are to."""
    lean, towards = _lean(force)
    if np.ndim(angle) and np.abs(lean - angle).max() > _HELD:
        return False
    if azimuth is None:
        return True
    # Wrapped to ± half a turn, and times sin(lean): an upright cable has no azimuth.
    turned = np.abs((towards - azimuth + np.pi) % (2 * np.pi) - np.pi)
    return bool((np.sin(lean) * turned).max() < _HELD and (lean >= _LEAST_LEAN * np.asarray(angle)).all())


def _astray(force: np.ndarray, angle: float | np.ndarray, azimuth: np.ndarray | None) -> float:
    """Return the largest angle between a cable and how it was to lean [rad], whose azimuth may be any if None."""
    lean, towards = _lean(force)
    asked = towards if azimuth is None else azimuth
    # The spherical law of cosines, of two directions with the vertical as third.
    cosine = np.cos(lean) * np.cos(angle) + np.sin(lean) * np.sin(angle) * np.cos(towards - asked)
    return float(np.arccos(np.clip(cosine, -1.0, 1.0)).max())


def _all_pull(force: np.ndarray, share: np.ndarray) -> bool:
    """Return whether every cable holds a little of its share (N,) [N] and stands above the payload."""
    level = np.hypot(force[:, 0], force[:, 1])
    return bool(np.all(force[:, 2] >= _LEAST_PULL * share) and np.all(level <= _FLATTEST * force[:, 2]))


def _bounded_shares(balance: np.ndarray, weight: float, share: np.ndarray) -> np.ndarray | None:
    """Return vertical forces (N,) [N] that balance a load, each at least `_LEAST_SHARE` of its own; None if none do.

    They are the nearest to `share` (N,) [N], each measured by its own: with x the forces beyond their bounds, over
    `share`, a problem of non-negative least squares whose first rows, which weigh most, are the balance.

    Args:
        balance: what vertical forces of one do (K, N): lift first, which must add up to the weight, then what must
            vanish.
        weight: of the load [N].
        share: (N,) [N].
    """
    own = share / weight
    balance = own * balance
    # Of a load of one, what is left for x once every cable has its least share.
    lacking = np.eye(len(balance))[0] - _LEAST_SHARE * balance.sum(axis=1)
    stacked = np.concatenate([_EXACT * balance, np.eye(len(own))])
    beyond = nonnegative_least_squares(stacked, np.concatenate([_EXACT * lacking, np.full(len(own), 1 - _LEAST_SHARE)]))
    missed = np.abs(balance @ beyond - lacking).max()
    return share * (_LEAST_SHARE + beyond) if missed < 1e-5 else None


def nonnegative_least_squares(matrix: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Return the x ≥ 0 (N,) that minimises |A x - b|, by Lawson and Hanson's algorithm (1974, chapter 23).

    Args:
        matrix: A (M, N).
        target: b (M,).
    """
    n = matrix.shape[1]
    x, free = np.zeros(n), np.zeros(n, bool)
    tolerance = 1e-10 * np.abs(matrix.T @ target).max()
    for _ in range(10 * n):  # each turn frees one of those at zero that would lower the error
        slope = np.where(free, -np.inf, matrix.T @ (target - matrix @ x))
        if slope.max() <= tolerance:
            break
        free[slope.argmax()] = True
        while True:  # of those that are free, the ones that would become negative are held at zero again
            best = np.zeros(n)
            best[free] = np.linalg.lstsq(matrix[:, free], target, rcond=None)[0]
            negative = free & (best <= 0)
            if not negative.any():
                break
            x += (x[negative] / (x[negative] - best[negative])).min() * (best - x)
            free &= x > 1e-12 * x.max()
            x[~free] = 0.0
        x = best
    return x
