"""Time and success of whole routes among obstacles: `python bench/route_search.py [maps=50] [drones=2,3,4,6,8]`.

CPU time of one thread, the shapes of a team found and kernels compiled before. "length" is the payload's way over the
straight line, "clearance" the least distance of any body from obstacles, its swing by inertia included. "onward" are
searches that begin in the middle of a route, with its motion.
"""

from __future__ import annotations

import sys

import numpy as np

from multilift_marl.config.load import load_config
from multilift_marl.navigation.formation_shapes import find_breach
from multilift_marl.navigation.planner import RouteSettings, find_route
from multilift_marl.planning.maps import CAPACITY, draw_map, place_map
from multilift_marl.planning.route import NoRoute, Route
from multilift_marl.rig.system import System
from multilift_marl.sim.obstacles import Obstacles

DEFAULTS = {"maps": "50", "drones": "2,3,4,6,8"}
LEVELS = "sparse", "dense", "narrow"
TITLES = "drones", "level", "found", "ms", "ms max", "length", "duration s", "clearance cm", "least", "states"
ONWARD = "shape limits kept", "onward found", "onward ms", "onward ms max"


def routes(level: str, seed: int, system: System) -> tuple[float, Route | None, Route | None]:
    """Return the distance from start to goal [m], the route of a map, and one that goes on from its middle."""
    drawn, obstacles = draw_map(level, seed, system), Obstacles.zeros(1, CAPACITY)
    place_map(0, drawn, obstacles)
    settings = RouteSettings(low=tuple(drawn.low), high=tuple(drawn.high))
    goal, apart = np.append(drawn.goal, 0.0), float(np.linalg.norm(drawn.goal - drawn.start))
    try:
        route = find_route(system, obstacles, 0, np.append(drawn.start, 0.0), goal, settings)
    except NoRoute:
        return apart, None, None
    try:
        middle = route.sample(np.array([0.5 * route.times[-1]]))[:, 0]
        return apart, route, find_route(system, obstacles, 0, goal, goal, settings, middle)
    except NoRoute:
        return apart, route, None


def measure(level: str, maps: int, system: System) -> list[str]:
    """Return the cells of one row."""
    found = [routes(level, seed, system) for seed in range(maps)]
    whole = [(apart, route) for apart, route, _ in found if route is not None]
    onward = [route.report.planning_time * 1e3 for _, _, route in found if route is not None]
    reports = [route.report for _, route in whole]
    times = np.array([report.planning_time * 1e3 for report in reports])
    length = np.median([route.report.length / apart for apart, route in whole])
    clearance = np.array([report.clearance * 100 for report in reports])
    kept = sum(
        all(find_breach(force, system) is None for force in route.evaluate(route.times)[2]) for _, route in whole
    )
    return [
        f"{len(whole)}/{maps}", f"{np.median(times):.0f}", f"{times.max():.0f}", f"{length:.2f}",
        f"{np.median([report.duration for report in reports]):.1f}", f"{np.median(clearance):.1f}",
        f"{clearance.min():.1f}", f"{np.median([report.expanded for report in reports]):.0f}", f"{kept}/{len(whole)}",
        f"{len(onward)}/{len(whole)}", f"{np.median(onward):.0f}", f"{max(onward):.0f}",
    ]  # fmt: skip


def main(arguments: list[str]) -> None:
    """Print a table."""
    values = DEFAULTS | dict(argument.split("=", 1) for argument in arguments)
    print(f"| {' | '.join(TITLES + ONWARD)} |", f"|{'---|' * len(TITLES + ONWARD)}", sep="\n")
    for drones in values["drones"].split(","):
        system = load_config("hover", {"env.num_drones": int(drones)}).system
        routes(LEVELS[0], 0, system)
        for level in LEVELS:
            print(f"| {drones} | {level} | {' | '.join(measure(level, int(values['maps']), system))} |", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
