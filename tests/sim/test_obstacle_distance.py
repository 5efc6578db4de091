"""Distances from obstacles against MuJoCo's, closed forms, and the definition of a nearest point."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from conftest import make_system

from multilift_marl.kernels.jit import kernel
from multilift_marl.mdp.failures import make_limits
from multilift_marl.sim import World
from multilift_marl.sim.obstacle_distance import (
    TeamBodies,
    _clearance,
    body_distance_to,
    box_distance_to,
    cylinder_distance_to,
    least_clearance,
    point_distance,
    ray_distance,
    segment_distance_to,
)
from multilift_marl.sim.obstacles import BOX, CYLINDER, HULL, NONE, SPHERE, Obstacles, place_obstacle

GEOMS = {BOX: "box", CYLINDER: "cylinder", SPHERE: "sphere", HULL: "mesh"}
CUBE = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
THIN = 1e-4  # [m] radius of the capsule that MuJoCo has in place of a segment


def random_rotation(rng) -> np.ndarray:
    q, r = np.linalg.qr(rng.normal(size=(3, 3)))
    q *= np.sign(np.diag(r))
    return q * np.linalg.det(q)


def random_hull(rng) -> np.ndarray:
    """Return vertices (12, 3) whose box has its middle at the origin."""
    points = rng.uniform(-1, 1, (12, 3)) * rng.uniform(0.2, 1.2, 3)
    return points - (points.max(axis=0) + points.min(axis=0)) / 2


def random_obstacle(rng, kind: int) -> tuple[Obstacles, np.ndarray]:
    hulls = random_hull(rng)[None]
    obstacles = Obstacles.zeros(1, 1)._replace(vertices=hulls)
    size = rng.uniform(0.1, 1.5, 3)
    if kind == CYLINDER:
        size[1] = size[0]
    elif kind == SPHERE:
        size[:] = size[0]
    elif kind == HULL:
        size = hulls[0].max(axis=0)
    place_obstacle(0, 0, obstacles, kind, tuple(size), tuple(rng.normal(size=3)))
    obstacles.rotation[0, 0] = random_rotation(rng)
    return obstacles, hulls


def pose(rotation) -> str:
    quat = np.zeros(4)
    mujoco.mju_mat2Quat(quat, np.ascontiguousarray(rotation).ravel())
    return " ".join(map(repr, quat.tolist()))


def words(values) -> str:
    return " ".join(repr(float(value)) for value in values)


def geom(obstacles: Obstacles, m: int = 0) -> str:
    """Return an obstacle as MuJoCo's XML; a HULL is the mesh "hull"."""
    kind, size = int(obstacles.kind[0, m]), obstacles.size[0, m]
    own = {BOX: size, CYLINDER: size[[0, 2]], SPHERE: size[:1]}.get(kind)
    shape = 'mesh="hull"' if own is None else f'size="{words(own)}"'
    place = f'pos="{words(obstacles.position[0, m])}" quat="{pose(obstacles.rotation[0, m])}"'
    return f'<geom name="obstacle" type="{GEOMS[kind]}" {shape} {place}/>'


def scene(*geoms: str, hull: np.ndarray = CUBE, own: np.ndarray = CUBE):
    asset = f'<mesh name="hull" vertex="{words(hull.ravel())}"/><mesh name="own" vertex="{words(own.ravel())}"/>'
    option = '<option ccd_iterations="200" ccd_tolerance="1e-9"/>'
    model = mujoco.MjModel.from_xml_string(
        f"<mujoco>{option}<asset>{asset}</asset><worldbody>{''.join(geoms)}</worldbody></mujoco>"
    )
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    return model, data


def geom_distance(obstacles: Obstacles, other: str, hull: np.ndarray, own: np.ndarray = CUBE) -> float:
    model, data = scene(geom(obstacles), other, hull=hull, own=own)
    return mujoco.mj_geomDistance(model, data, 0, 1, 100.0, None)


@pytest.mark.parametrize("kind", GEOMS)
@pytest.mark.parametrize("body", ["box", "cylinder", "segment", "hull"])
def test_distances_of_bodies_are_mujocos(kind, body):
    rng = np.random.default_rng([kind, len(body)])
    apart = 0
    for _ in range(60):
        obstacles, hulls = random_obstacle(rng, kind)
        center, frame, half = rng.normal(size=3) * 1.5, random_rotation(rng), rng.uniform(0.02, 0.6, 3)
        nine, place = tuple(frame.ravel()), f'pos="{words(center)}" quat="{pose(frame)}"'
        if body == "box":
            ours = box_distance_to(0, 0, tuple(center), nine, tuple(half), obstacles)
            theirs = geom_distance(obstacles, f'<geom type="box" size="{words(half)}" {place}/>', hulls[0])
        elif body == "cylinder":
            ours = cylinder_distance_to(0, 0, tuple(center), nine, (half[0], half[0], half[2]), obstacles)
            theirs = geom_distance(obstacles, f'<geom type="cylinder" size="{words(half[[0, 2]])}" {place}/>', hulls[0])
        elif body == "hull":
            own = random_hull(rng)
            obstacles = obstacles._replace(vertices=np.stack([own, np.resize(hulls[0], own.shape)]))
            obstacles.hull[:] = 1
            ours = body_distance_to(0, 0, (HULL, tuple(center), nine, 0), obstacles, np.inf)
            theirs = geom_distance(obstacles, f'<geom type="mesh" mesh="own" {place}/>', hulls[0], own)
        else:
            a, b = tuple(center), tuple(center + rng.normal(size=3))
            ours = segment_distance_to(0, 0, a, b, obstacles)
            theirs = geom_distance(obstacles, f'<geom type="capsule" size="{THIN}" fromto="{words(a + b)}"/>', hulls[0])
            theirs += THIN
        assert ours == pytest.approx(max(theirs, 0.0), abs=1e-4 if theirs > THIN else 2 * THIN)
        apart += ours > 0
    assert 20 < apart < 60


@pytest.mark.parametrize("kind", [BOX, CYLINDER, SPHERE, HULL])
def test_distances_of_points_are_those_of_small_spheres(kind):
    """Of MuJoCo, whose penetration is to the nearest face, too; inside a hull it is zero."""
    rng = np.random.default_rng(kind)
    inside = 0
    for _ in range(100):
        obstacles, hulls = random_obstacle(rng, kind)
        point = obstacles.position[0, 0] + obstacles.rotation[0, 0] @ (rng.uniform(-1.6, 1.6, 3) * obstacles.size[0, 0])
        ours, nearest = point_distance(0, 0, tuple(point), obstacles)
        theirs = geom_distance(obstacles, f'<geom type="sphere" size="1e-4" pos="{words(point)}"/>', hulls[0]) + 1e-4
        inside += theirs < 0
        assert ours == pytest.approx(max(theirs, 0.0) if kind == HULL else theirs, abs=1e-4)
        # The nearest point is as far as the distance says, and on the surface.
        assert np.linalg.norm(np.subtract(nearest, point)) == pytest.approx(abs(ours), abs=1e-6)
        assert abs(point_distance(0, 0, nearest, obstacles)[0]) < 1e-6
    assert inside > 2


@pytest.mark.parametrize("kind", [BOX, CYLINDER, SPHERE, HULL])
def test_rays_are_mujocos(kind):
    rng = np.random.default_rng(kind)
    hits = 0
    for _ in range(120):
        obstacles, hulls = random_obstacle(rng, kind)
        model, data = scene(geom(obstacles), hull=hulls[0])
        origin = obstacles.position[0, 0] + 4 * random_rotation(rng)[0]
        toward = obstacles.position[0, 0] + rng.normal(size=3) * 0.7 - origin
        direction = toward / np.linalg.norm(toward)
        theirs = mujoco.mj_ray(model, data, origin, direction, None, 1, -1, np.zeros(1, np.int32), None)
        ours = ray_distance(0, 0, tuple(origin), tuple(direction), obstacles)
        hits += theirs >= 0
        assert ours == (pytest.approx(theirs, abs=1e-5) if theirs >= 0 else np.inf)
        assert ray_distance(0, 0, tuple(origin), tuple(-direction), obstacles) == np.inf
    assert 30 < hits < 120


def unit(kind: int, position=(0.0, 0.0, 0.0), yaw: float = 0.0) -> Obstacles:
    """Return an obstacle whose half edges are 1 m."""
    obstacles = Obstacles.zeros(1, 1)._replace(vertices=CUBE[None])
    place_obstacle(0, 0, obstacles, kind, (1.0, 1.0, 1.0), position, yaw)
    return obstacles


LEVEL = tuple(np.eye(3).ravel())


@pytest.mark.parametrize(
    "kind, point, distance, nearest",
    [
        (BOX, (3, 0.5, 0), 2, (1, 0.5, 0)),
        (BOX, (4, 5, 0), 5, (1, 1, 0)),
        (BOX, (0.1, 0, -0.7), -0.3, (0.1, 0, -1)),
        (CYLINDER, (3, 4, 0), 4, (0.6, 0.8, 0)),
        (CYLINDER, (4, 0, 5), 5, (1, 0, 1)),
        (CYLINDER, (0.2, 0.2, 0.9), -0.1, (0.2, 0.2, 1)),
        (CYLINDER, (0, -0.9, 0), -0.1, (0, -1, 0)),
        (CYLINDER, (0, 0, 0), -1, (1, 0, 0)),
        (SPHERE, (0, 3, 4), 4, (0, 0.6, 0.8)),
        (SPHERE, (0, 0, 0), -1, (0, 0, 1)),
        (HULL, (3, 0.5, 0), 2, (1, 0.5, 0)),
        (HULL, (0.2, 0.1, 0), 0, (0.2, 0.1, 0)),
    ],
)
def test_distances_of_points_by_hand(kind, point, distance, nearest):
    point = tuple(map(float, point))
    measured, found = point_distance(0, 0, point, unit(kind))
    assert measured == pytest.approx(distance, abs=1e-9) and found == pytest.approx(nearest, abs=1e-9)
    # Moved and turned by a quarter it is the same.
    turned = -point[1] + 2.0, point[0] - 3.0, point[2] + 1.0
    moved = unit(kind, (2.0, -3.0, 1.0), np.pi / 2)
    assert point_distance(0, 0, turned, moved)[0] == pytest.approx(distance, abs=1e-9)


@pytest.mark.parametrize("kind", GEOMS)
def test_rays_by_hand(kind):
    obstacles = unit(kind)
    ray = lambda *numbers: ray_distance(0, 0, numbers[:3], numbers[3:], obstacles)  # noqa: E731
    assert ray(3.0, 0.0, 0.0, -1.0, 0.0, 0.0) == pytest.approx(2.0, abs=1e-6)
    assert ray(0.0, 0.0, 5.0, 0.0, 0.0, -1.0) == pytest.approx(4.0, abs=1e-6)
    assert ray(3.0, 0.0, 0.0, 1.0, 0.0, 0.0) == ray(3.0, 1.5, 0.0, -1.0, 0.0, 0.0) == np.inf
    assert ray(0.3, 0.2, 0.1, 0.6, 0.0, 0.8) == 0.0


@pytest.mark.parametrize("kind", GEOMS)
def test_degenerate_bodies_have_distances_too(kind):
    """Parallel faces, a common middle, a shared face, a segment of no length, and one through the middle."""
    obstacles, half = unit(kind), (0.5, 0.5, 0.5)
    for measure in (box_distance_to, cylinder_distance_to):
        far = lambda *center, measure=measure: measure(0, 0, center, LEVEL, half, obstacles)  # noqa: E731
        assert far(0.0, 0.0, 2.0) == pytest.approx(0.5, abs=1e-6)
        assert far(0.0, 0.0, 1.5 + 1e-4) == pytest.approx(1e-4, abs=1e-6)
        assert far(0.0, 0.0, 0.0) == far(0.0, 0.0, 1.5 - 1e-6) == 0.0
        assert far(0.0, 0.0, 1.5) <= 1e-6
        assert far(0.0, 0.0, 100.0) == pytest.approx(98.5, abs=1e-6)
    segment = lambda *ends: segment_distance_to(0, 0, ends[:3], ends[3:], obstacles)  # noqa: E731
    assert segment(0.0, 0.0, 3.0, 0.0, 0.0, 3.0) == pytest.approx(2.0, abs=1e-6)
    assert segment(-2.0, 0.0, 0.0, 2.0, 0.0, 0.0) == segment(0.0, 0.0, 0.0, 0.0, 0.0, 0.0) == 0.0
    assert segment(-2.0, 0.0, 1.25, 2.0, 0.0, 1.25) == pytest.approx(0.25, abs=1e-6)


def test_free_rows_are_infinitely_far():
    obstacles = unit(BOX)
    obstacles.kind[:] = NONE
    point, axis = (0.0, 0.0, 0.0), (0.0, 0.0, 1.0)
    assert point_distance(0, 0, point, obstacles)[0] == np.inf
    assert ray_distance(0, 0, point, axis, obstacles) == np.inf
    assert segment_distance_to(0, 0, point, axis, obstacles) == np.inf
    assert box_distance_to(0, 0, point, LEVEL, (1.0, 1.0, 1.0), obstacles) == np.inf


@kernel
def clearances(team, nodes, obstacles, within, out):
    for e in range(out.shape[0]):
        out[e] = least_clearance(e, team, nodes, obstacles, within)


def clearance(world: World, obstacles: Obstacles, within=np.inf, lost=None) -> np.ndarray:
    out = np.zeros(world.num_envs)
    lost = np.zeros((world.num_envs, world.num_drones), bool) if lost is None else lost
    team = TeamBodies(world.state, world.rig, make_limits(world.system), lost)
    clearances(team, world.nodes, obstacles, within, out)
    return out


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_long_body_is_near_what_is_before_its_ends(axis):
    """Whichever of its axes is the long one: what its sphere does not reach is left out."""
    half, place = [0.1, 0.1, 0.1], [0.0, 0.0, 0.0]
    half[axis], place[axis] = 3.0, 3.0 + 0.3 + 1.0
    axes = tuple(np.diag(half).ravel())
    body = BOX, (0.0, 0.0, 0.0), axes, 0
    found = _clearance.py_func(0, body, np.linalg.norm(half), unit(BOX, tuple(place)), 0.5)
    assert found == pytest.approx(0.3, abs=1e-6)


@pytest.mark.parametrize(
    ("kind", "size"), [(SPHERE, (0.1, 0.1, 0.1)), (BOX, (0.05, 0.05, 1.0)), (HULL, (0.1, 0.1, 0.1))]
)
def test_a_mesh_is_as_near_as_its_own_hull(tmp_path, kind, size):
    """Beside an edge of a square that stands on its corner, far within the box about it."""
    points = [(x, y, z) for z in (0.0, 0.15) for x, y in ((0.4, 0.0), (0.0, 0.4), (-0.4, 0.0), (0.0, -0.4))]
    faces = [(4, 3, 2, 1), (5, 6, 7, 8), (1, 2, 6, 5), (2, 3, 7, 6), (3, 4, 8, 7), (4, 1, 5, 8)]
    lines = [f"v {x} {y} {z}" for x, y, z in points] + ["f " + " ".join(map(str, face)) for face in faces]
    (tmp_path / "square.obj").write_text("\n".join(lines))
    (tmp_path / "ball.obj").write_text("\n".join(lines))
    ends = [[0.35, 0, 0.07], [0, 0.35, 0.07], [-0.35, 0, 0.07], [0, -0.35, 0.07]]
    rock = [{"shape": "mesh", "mesh": str(tmp_path / "ball.obj"), "size": [0.2, 0.2, 0.2], "position": [0, 0, -50]}]
    mesh = {"payload.shape": "mesh", "payload.mesh": str(tmp_path / "square.obj"), "payload.anchors": ends}
    world = World(make_system(4, **mesh, **{"scene.obstacles": rock}), 1, 1)
    middle = world.state.payload_position[0] + world.state.payload_rotation[0] @ world.system.payload_center
    obstacles = Obstacles.zeros(1, 1)._replace(vertices=world.obstacles.vertices)
    place_obstacle(0, 0, obstacles, kind, size, tuple(middle + [0.33, 0.33, 0.0]))
    # of the edge x + y = 0.4; the corner of an upright box is nearest to it, the edge of the rock is parallel
    near = {SPHERE: 0.1, BOX: 0.1 / np.sqrt(2), HULL: 0.1 / np.sqrt(2)}[kind]
    assert clearance(world, obstacles)[0] == pytest.approx((0.66 - 0.4) / np.sqrt(2) - near, abs=1e-6)


@pytest.mark.parametrize("gap", [0.02, 0.3])
def test_a_point_is_as_near_as_the_ball_that_stands_for_it(gap):
    """On the diagonal of the cube about it: its corner is 3.7 cm farther out than the ball."""
    world = World(make_system(3, **{"payload.shape": "point", "payload.mass": 0.7}), 1, 1)
    away = np.array([1.0, 1.0, -1.0]) / np.sqrt(3)
    obstacles = Obstacles.zeros(1, 1)
    place_obstacle(
        0, 0, obstacles, SPHERE, (0.1, 0.1, 0.1), tuple(world.state.payload_position[0] + (0.15 + gap) * away)
    )
    assert clearance(world, obstacles)[0] == pytest.approx(gap, abs=1e-9)


def random_team(rng, **overrides) -> World:
    """Return eight teams, somewhere and turned as bodies without cables could be."""
    world = World(make_system(3, **overrides), 8, 1)
    state = world.state
    state.payload_position[:] += rng.normal(size=(8, 3)) * 0.3
    state.drone_position[:] += rng.normal(size=(8, 3, 3)) * 0.2
    for e in range(8):
        state.payload_rotation[e] = random_rotation(rng)
        for n in range(3):
            state.drone_rotation[e, n] = random_rotation(rng)
    return world


def random_field(rng, count: int = 20) -> Obstacles:
    obstacles = Obstacles.zeros(8, count)
    for e in range(8):
        for m in range(count - 1):  # the last row stays free
            one, _ = random_obstacle(rng, int(rng.choice([BOX, CYLINDER, SPHERE])))
            for name in ("kind", "size", "rotation"):
                getattr(obstacles, name)[e, m] = getattr(one, name)[0, 0]
            direction = rng.normal(size=3)
            obstacles.position[e, m] = [0, 0, 1.5] + rng.uniform(1.5, 8) * direction / np.linalg.norm(direction)
    return obstacles


def all_distances(world: World, obstacles: Obstacles, e: int) -> list[float]:
    """Return the distances of all bodies of a team from all obstacles, none left out."""
    state, system, limits, found = world.state, world.system, make_limits(world.system), []
    for m in np.flatnonzero(obstacles.kind[e]).tolist():
        attitude = state.payload_rotation[e]
        middle = tuple(state.payload_position[e] + attitude @ system.payload_center)
        measure = cylinder_distance_to if limits.payload_round else box_distance_to
        found.append(measure(e, m, middle, tuple(attitude.ravel()), tuple(limits.payload_half), obstacles))
        for n in range(3):
            frame = tuple(state.drone_rotation[e, n].ravel())
            center = tuple(state.drone_position[e, n])
            found.append(box_distance_to(e, m, center, frame, tuple(limits.drone_half[n]), obstacles))
            points = [tuple(point) for point in world.cable_points(e, n)]
            found += [segment_distance_to(e, m, a, b, obstacles) for a, b in zip(points, points[1:], strict=False)]
    return found


@pytest.mark.parametrize(
    "overrides",
    [
        {},
        {"payload.shape": "cylinder", "payload.size": [0.4, 0.4, 0.2]},
        {"cable.model": "chain", "cable.density": 0.05},
    ],
    ids=["box", "cylinder", "chain"],
)
def test_the_least_clearance_is_the_least_of_all_distances(overrides):
    rng = np.random.default_rng(3)
    world, obstacles = random_team(rng, **overrides), random_field(rng)
    if world.nodes is not None:
        world.nodes.position[:] = world.state.payload_position[:, None, None] + rng.normal(size=3) * 0.3
    measured = clearance(world, obstacles)
    expected = [min(all_distances(world, obstacles, e)) for e in range(8)]
    assert measured == pytest.approx(expected, abs=1e-6)
    assert 0 < np.count_nonzero(measured) and measured.max() > 0.05
    assert clearance(world, obstacles, within=0.05) == pytest.approx(np.minimum(expected, 0.05), abs=1e-6)


def test_a_touch_is_found_and_lost_drones_and_broken_cables_touch_nothing():
    world = World(make_system(2), 1, 1)
    state, lost = world.state, np.zeros((1, 2), bool)
    touch = lambda: clearance(world, obstacles, 1e-6, lost)[0] == 0.0  # noqa: E731
    # A small ball on the middle of a cable, then one on a drone.
    anchor, hook = world.cable_points(0, 0)
    obstacles = Obstacles.zeros(1, 2)
    place_obstacle(0, 0, obstacles, SPHERE, (0.05, 0.05, 0.05), tuple((anchor + hook) / 2 + [0, 0.04, 0]))
    assert touch()
    world.break_cables(np.array([[True, False]]))
    assert not touch()
    place_obstacle(0, 1, obstacles, SPHERE, (0.05, 0.05, 0.05), tuple(state.drone_position[0, 1]))
    assert touch()
    lost[0, 1] = True
    assert not touch()
    obstacles.kind[:] = NONE
    assert clearance(world, obstacles, lost=lost) == np.inf
