"""Obstacles in physics: what they are in MuJoCo, how they move, and that environments have their own."""

import numpy as np
import pytest
from conftest import load, make, make_system, refuse_system, zeros
from test_contact import FALL, without_drag

from multilift_marl.rig.obstacles import BOX, CYLINDER, SPHERE, resolve_scenery
from multilift_marl.schema.scene import SceneConfig
from multilift_marl.sim import World
from multilift_marl.sim.obstacle_bodies import box_distance
from multilift_marl.sim.obstacles import half_extents, place_obstacle

TOP = 0.6


def make_world(num_envs: int = 1, **scene) -> World:
    """Return worlds whose payload, 0.1 m high, is free at 1 m above the origin, its drone far away."""
    keys = {f"scene.{key}": value for key, value in scene.items()}
    world = World(without_drag(make_system(1, **FALL | keys)), num_envs, 1)
    return world


def let_go(world: World, seconds: float = 2.0, height: float = 1.0) -> np.ndarray:
    """Let payloads fall, and return their heights (E,) at the end [m]."""
    world.state.payload_position[:] = [0, 0, height]
    world.state.payload_velocity[:] = 0
    world.state.payload_rotation[:] = world.state.drone_rotation[:] = np.eye(3)
    world.state.drone_position[:] = [0, 10.0, 15.0]
    world.state.rotor_speed[:] = 0
    load(world)
    world.break_cables(np.ones((world.num_envs, 1), bool))
    world.hidden_loads.motors_off[:] = True
    world.step(np.zeros((world.num_envs, 1, 4)), round(seconds / world.system.timestep))
    return world.state.payload_position[:, 2].copy()


@pytest.fixture(scope="module")
def cube(tmp_path_factory):
    """A file of a cube of edge 2, off the origin."""
    path = tmp_path_factory.mktemp("mesh") / "cube.obj"
    corners = [(x, y, z) for x in (1, 3) for y in (0, 2) for z in (4, 6)]
    faces = ["1 2 4 3", "5 7 8 6", "1 5 6 2", "3 4 8 7", "1 3 7 5", "2 6 8 4"]
    triangles = [f"f {a} {b} {c}\nf {a} {c} {d}" for a, b, c, d in (face.split() for face in faces)]
    path.write_text("".join(f"v {x} {y} {z}\n" for x, y, z in corners) + "\n".join(triangles) + "\n")
    return str(path)


@pytest.mark.parametrize("shape", ["box", "cylinder", "sphere", "wall", "mesh"])
def test_a_payload_rests_on_top(shape, cube):
    size = {
        "box": [0.8, 0.8, TOP],
        "cylinder": [0.8, TOP],
        "sphere": [TOP],
        "wall": [0.8, 0.8, TOP],
        "mesh": [0.8, 0.8, TOP],
    }
    given = {"shape": shape, "size": size[shape], "position": [0, 0, TOP / 2]}
    if shape == "mesh":
        given["mesh"] = cube
    world = make_world(obstacles=[given])
    assert let_go(world)[0] == pytest.approx(TOP + 0.05, abs=2e-3)


def test_a_lying_cylinder_and_a_turned_box_are_as_turned():
    lying = {"shape": "cylinder", "size": [0.4, 2.0], "position": [0, 0, 0.2], "rotation": [90, 0, 0]}
    assert let_go(make_world(obstacles=[lying]))[0] == pytest.approx(0.45, abs=2e-3)
    # A bar of 2 x 0.1 m turned by 90° about z lies under the payload at x = 0 only along y.
    bar = {"shape": "box", "size": [2.0, 0.4, 0.5], "position": [0, 0.9, 0.25], "rotation": [0, 0, 90]}
    assert let_go(make_world(obstacles=[bar]))[0] == pytest.approx(0.55, abs=2e-3)


def test_drones_stop_at_walls():
    world = make_world(obstacles=[{"shape": "box", "size": [0.2, 4, 4], "position": [1.0, 0, 2]}])
    let_go(world, 0.0, height=0.05)
    world.state.drone_position[:] = [0, 0, 1.5]
    world.state.drone_velocity[:] = [6.0, 0, 0]
    load(world)
    world.break_cables(np.ones((1, 1), bool))
    farthest = 0.0
    for _ in range(200):
        world.step(np.zeros((1, 1, 4)))
        farthest = max(farthest, float(world.state.drone_position[0, 0, 0]))
    # It is at rest within the way of a physics step.
    face = 0.9 - world.system.vehicles[0].half_size[0]
    assert face - 0.005 < farthest < face + 6.0 * world.system.timestep


def test_each_environment_has_the_obstacles_that_its_task_places():
    world = make_world(3, reserved=2)
    place_obstacle(0, 0, world.obstacles, BOX, (0.4, 0.4, 0.1), (0, 0, 0.1))
    place_obstacle(1, 1, world.obstacles, SPHERE, (0.25, 0.25, 0.25), (0, 0, 0.25))
    heights = let_go(world)
    assert heights == pytest.approx([0.25, 0.55, 0.05], abs=2e-3)
    # another form in the same row
    place_obstacle(0, 0, world.obstacles, CYLINDER, (0.4, 0.4, 0.2), (0, 0, 0.2))
    assert let_go(world)[0] == pytest.approx(0.45, abs=2e-3)


def test_moving_obstacles_follow_their_sine_and_push():
    moving = {"shape": "box", "size": [0.1, 1, 1], "position": [-1, 0, 0.5], "travel": [0.5, 0, 0], "period": 4.0}
    world = make_world(obstacles=[moving])
    let_go(world, 0.0, height=0.05)
    positions, velocities = [], []
    for _ in range(250):
        world.step(np.zeros((1, 1, 4)))
        positions.append(world.obstacles.position[0, 0, 0])
        velocities.append(world.obstacles.velocity[0, 0, 0])
    times = world.system.timestep * np.arange(1, 251)
    np.testing.assert_allclose(positions, -1 + 0.5 * np.sin(2 * np.pi * times / 4), atol=1e-12)
    np.testing.assert_allclose(np.gradient(positions, times)[1:-1], velocities[1:-1], atol=1e-4)
    # At 1 s its face is at -0.45 m, where the payload's edge was at -0.15 - nothing touched; moved nearer it does.
    assert world.state.payload_position[0, 0] == pytest.approx(0.0, abs=1e-6)
    world = make_world(obstacles=[moving | {"position": [-0.5, 0, 0.5]}])
    let_go(world, 1.0, height=0.05)
    assert world.state.payload_position[0, 0] == pytest.approx(0.2, abs=0.01)


def test_saved_states_hold_obstacles():
    scene = {
        "obstacles": [{"shape": "sphere", "size": [0.4], "position": [0, 0, 0.2], "travel": [0.3, 0, 0], "period": 1.0}]
    }
    one, other = (make_world(2, **scene, reserved=1) for _ in range(2))
    place_obstacle(1, 1, one.obstacles, BOX, (0.3, 0.3, 0.3), (0, 0, 0.3))
    let_go(one, 0.3)
    other.load_state_dict(one.state_dict())
    for world in (one, other):
        world.step(np.zeros((2, 1, 4)), 300)
    assert np.array_equal(one.state.payload_position, other.state.payload_position)
    assert abs(one.state.payload_position[0, 2] - one.state.payload_position[1, 2]) > 0.05


def test_the_box_about_an_obstacle_bounds_its_distance():
    world = make_world(obstacles=[{"shape": "box", "size": [2, 1, 1], "position": [1, 2, 3], "rotation": [0, 0, 90]}])
    distance = box_distance(0, 0, (1.0, 5.0, 3.0), world.obstacles)
    assert distance == pytest.approx(2.0)
    assert box_distance(0, 0, (1.2, 2.9, 3.4), world.obstacles) == 0.0


def test_gaps_leave_the_rest_of_a_wall():
    gaps = [[0.0, 1.0], [2.0, 0.5, 1.0, 2.0]]
    wall = {"shape": "wall", "size": [0.1, 6.0, 3.0], "position": [0, 0, 1.5], "gaps": gaps}
    found = resolve_scenery(SceneConfig.model_validate({"obstacles": [wall]})).obstacles
    volume = sum(8 * each.size.prod() for each in found)
    assert volume == pytest.approx(0.1 * (6 * 3 - 1.0 * 3 - 0.5 * 1.0))
    for point, solid in (((0, 0, 1), False), ((0, 2, 1.5), False), ((0, 2, 0.5), True), ((0, 1, 1), True)):
        inside = [(np.abs(np.array(point) - each.position) <= each.size).all() for each in found]
        assert any(inside) == solid


@pytest.mark.parametrize(
    ("given", "text"),
    [
        ({"shape": "box"}, "scene.obstacles[0] has no size; give 3"),
        ({"shape": "sphere", "size": [1, 2]}, "size has 2 numbers, but a sphere has 1"),
        ({"shape": "box", "size": [1, 1, 1], "gaps": [[0, 1]]}, "are of walls"),
        ({"shape": "wall", "size": [1, 2, 2], "gaps": [[0.9, 1]]}, "overlaps another or leaves the wall"),
        ({"shape": "wall", "size": [1, 2, 2], "gaps": [[-0.5, 1], [0, 1]]}, "overlaps another or leaves the wall"),
        ({"shape": "wall", "size": [1, 2, 2], "gaps": [[0, 2]]}, "leave nothing of the wall"),
        ({"shape": "mesh"}, "set its mesh to a file"),
        ({"shape": "box", "size": [1, 1, 1], "mesh": "nowhere.obj"}, "nowhere.obj"),
        ({"shape": "cone", "size": [1, 1, 1]}, "scene.obstacles"),
        ({"shape": "box", "size": [1, 1, -1]}, "scene.obstacles"),
        ({"shape": "box", "size": [1, 1, 1], "period": 0.0}, "from 0.1 to 1e+06 s"),
        ({"shape": "box", "size": [1, 1, 1], "position": [0, 0, float("nan")]}, "scene.obstacles"),
        ({"form": "box"}, "scene.obstacles"),
    ],
)
def test_obstacles_that_cannot_be_are_refused(given, text):
    assert text in refuse_system(4, **{"scene.obstacles": [given]})


@pytest.mark.parametrize(
    ("key", "row", "value"), [("kind", 1, 4), ("kind", 1, -1), ("hull", 1, 10**9), ("size", 0, 2.0), ("kind", 0, 1)]
)
def test_saved_obstacles_that_are_not_theirs_are_refused(key, row, value):
    ball = {"shape": "sphere", "size": [0.4], "position": [0, 0, 0.2]}
    world = make_world(1, obstacles=[ball], reserved=1)
    saved = world.state_dict()
    saved[f"obstacles.{key}"][0, row] = value
    with pytest.raises(ValueError, match=rf"'obstacles.{key}' holds obstacles that are not theirs"):
        world.load_state_dict(saved)


def test_obstacles_that_move_too_fast_are_refused():
    fast = {"shape": "sphere", "size": [0.4], "travel": [1, 0, 0], "period": 1.0}
    assert "moves at up to 6.28 m/s, and may at 5" in refuse_system(4, **{"scene.obstacles": [fast]})


def test_moving_obstacles_start_anew_with_an_episode():
    moving = {"shape": "sphere", "size": [1.0], "position": [0, 0, 1.5], "travel": [9, 0, 0], "period": 20.0}
    vec = make("hover", num_envs=8, **{"scene.obstacles": [moving | {"phase": 0.25}]})
    vec.reset(seed=3)
    first = vec.world.state.payload_position.copy()
    for _ in range(10):
        vec.step(zeros(vec))
    vec.world.obstacles.position[:, 0, 0] = 0.0  # as if it had come to where teams start
    vec.reset(seed=3)
    assert np.array_equal(vec.world.state.payload_position, first)
    assert (vec.world.obstacles.position[:, 0, 0] == 9.0).all() and (vec.task.min_clearance > 0.5).all()


def test_half_extents_of_turned_boxes_and_cylinders_and_of_balls():
    c, s = np.cos(0.6), np.sin(0.6)
    turned = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    lying = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    sizes = np.array([[0.5, 0.2, 1.0], [0.3, 0.3, 2.0], [0.4, 0.4, 0.4]])
    found = half_extents(np.array([BOX, CYLINDER, SPHERE]), sizes, np.array([turned, lying, turned]))
    box = [0.5 * c + 0.2 * s, 0.5 * s + 0.2 * c, 1.0]
    np.testing.assert_allclose(found, [box, [0.3, 2.0, 0.3], [0.4, 0.4, 0.4]], atol=1e-12)
    assert half_extents(np.zeros(0, int), np.zeros((0, 3)), np.zeros((0, 3, 3))).shape == (0, 3)
