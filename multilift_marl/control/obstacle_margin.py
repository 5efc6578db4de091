"""Set-points that stay clear of the obstacles that a drone sees itself (`control.obstacle_margin`).

Each point that is seen forbids what is nearer to it, along the line from it to the drone: a half-space, as in buffered
Voronoi cells (Zhou et al., IEEE RA-L 2017). Set-points are moved out of all of them by projections in turn. What is
forbidden turns as the drone moves, so that it slides along an obstacle.
"""

from __future__ import annotations

from multilift_marl.kernels.jit import kernel
from multilift_marl.math3d import add, dot, norm, put, row, scale, sub, vec

SWEEPS = 4
LAG = 3.0
"""Of references behind a command that moves at a speed, times the speed over their frequency, see `smooth`."""


@kernel
def keep_clear(lo, hi, team, margin, smoothing):
    """Move commanded positions of environments lo to hi out of the margin [m] about what the drones see.

    Args:
        lo, hi: the environments.
        team: ControlContext with obstacles.
        margin: from the drone's centre [m].
        smoothing: of the references: where they will be at rest beside the goal is kept clear.
    """
    goal, command = team.goal, team.reference.command
    for e in range(lo, hi):
        lead = scale(LAG / smoothing.frequency, row(goal.velocity, e))
        for n in range(command.shape[1]):
            place = vec(team.state.drone_position, e, n)
            way = sub(add(vec(command, e, n), lead), place)
            for _ in range(SWEEPS):
                for j in range(team.obstacles.shape[2]):
                    point = team.obstacles[e, n, j]
                    away = sub(place, (point[0], point[1], point[2]))
                    distance = norm(away)
                    if distance > 0.0:
                        lacks = margin - distance - dot(way, away) / distance
                        if lacks > 0.0:
                            way = add(way, scale(lacks / distance, away))
            put(command[e, n], sub(add(place, way), lead))
