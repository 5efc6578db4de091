"""What a bag holds beside the flight's state: geometry as MuJoCo has it, walls, the start, actions, covariances."""

from __future__ import annotations

import sqlite3
from pathlib import Path

import mujoco
import numpy as np
import pytest

import multilift_marl as ml
from multilift_marl.policies.baselines import make_scripted

pytest.importorskip("rosbags")  # of the ros extra
from ros_wire import Wire
from test_ros import place, read, rotation

from multilift_marl.deploy.ros.bag import BagWriter
from multilift_marl.deploy.ros.live import LiveFlight
from multilift_marl.deploy.ros.markers import _HEAVY, CUBE, CYLINDER, SPHERE, TRIANGLES
from multilift_marl.deploy.ros.messages import FlightMessages
from multilift_marl.deploy.ros.types import EXACT
from multilift_marl.sim.obstacle_distance import ray_distance
from multilift_marl.sim.scene import build_model

TWO = {"num_drones": 2, "payload.mass": 0.7}


def make(task: str = "hover", **overrides):
    vec = ml.make_vec(task, num_envs=1, num_threads=1, **overrides)
    vec.reset(seed=1)
    return vec


# Geometry


def hit_box(half, origin, way) -> float:
    with np.errstate(divide="ignore"):
        near, far = np.sort([(-half - origin) / way, (half - origin) / way], axis=0)
    return near.max() if near.max() <= far.min() and near.max() > 0 else np.inf


def hit_ball(half, origin, way) -> float:
    o, w = origin / half, way / half
    a, b, c = w @ w, o @ w, o @ o - 1
    root = b * b - a * c
    return (-b - np.sqrt(root)) / a if root >= 0 and b < 0 else np.inf


def hit_cylinder(half, origin, way) -> float:
    a, b, c = way[:2] @ way[:2], origin[:2] @ way[:2], origin[:2] @ origin[:2] - half[0] ** 2
    hits = [(-b - np.sqrt(b * b - a * c)) / a] if b * b >= a * c else []
    hits = [t for t in hits if abs(origin[2] + t * way[2]) <= half[2]]
    for end in (-half[2], half[2]):
        t = (end - origin[2]) / way[2]
        hits += [t] if np.hypot(*(origin + t * way)[:2]) <= half[0] else []
    return min((t for t in hits if t > 0), default=np.inf)


def hit_triangles(points, origin, way) -> float:
    """Möller and Trumbore 1997."""
    a, b, c = points.reshape(-1, 3, 3).transpose(1, 0, 2)
    p = np.cross(way, c - a)
    with np.errstate(divide="ignore", invalid="ignore"):
        f = 1 / np.einsum("ij,ij->i", b - a, p)
        u = f * np.einsum("ij,ij->i", origin - a, p)
        q = np.cross(origin - a, b - a)
        v = f * (q @ way)
        t = f * np.einsum("ij,ij->i", c - a, q)
    return min(t[(u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0)], default=np.inf)


def hit(marker, frames, origin, way) -> float:
    """Return how far a ray of unit direction goes until it meets a marker, as its type defines it."""
    position, attitude = frames[marker.header.frame_id]
    own = attitude @ rotation(marker.pose.orientation)
    centre = position + attitude @ place(marker.pose.position)
    origin, way, half = own.T @ (origin - centre), own.T @ way, 0.5 * place(marker.scale)
    if marker.type == TRIANGLES:
        return hit_triangles(np.array([place(point) for point in marker.points]), origin, way)
    return {CUBE: hit_box, SPHERE: hit_ball, CYLINDER: hit_cylinder}[marker.type](half, origin, way)


def write_wedge(path: Path) -> Path:
    """Write a closed surface without any symmetry: a tetrahedron."""
    corners = "v 0 0 0\nv 0.5 0.1 0\nv 0.1 0.4 0\nv 0.2 0.1 0.3\n"
    path.write_text(corners + "f 1 3 2\nf 1 2 4\nf 2 3 4\nf 3 1 4\n")
    return path


@pytest.mark.parametrize("rig", ["box", "auto6", "point", "mesh"])
def test_markers_are_the_geoms_that_mujoco_has(rig, tmp_path):
    """Rays from all around meet markers where they meet the geoms; every body turned and moved."""
    own = {
        "box": TWO | {"payload.center_of_mass": [0.05, 0.0, 0.02]},
        "auto6": {}, "point": TWO | {"payload.shape": "point"},
        "mesh": {"num_drones": 3, "payload.mass": 0.9, "payload.shape": "mesh",
                 "payload.mesh": str(write_wedge(tmp_path / "wedge.obj"))},
    }[rig]  # fmt: skip
    vec = make("rigs/auto6" if rig == "auto6" else "hover", **own)
    rng = np.random.default_rng(0)
    for _ in range(20):
        vec.step(rng.uniform(-1, 1, (1, vec.num_drones, 4)))
    with BagWriter(tmp_path / "bag", vec):
        pass
    heard = read(tmp_path / "bag")
    ((_, scene, _),) = heard["/scene"]
    frames = {"world": (np.zeros(3), np.eye(3))}
    for each in heard["/tf"][0][1].transforms:
        frames[each.child_frame_id] = place(each.transform.translation), rotation(each.transform.rotation)
    model, _ = build_model(vec.world.system, visuals=True)
    data, state = mujoco.MjData(model), vec.world.state
    for name, (position, attitude) in list(frames.items())[1:]:
        quaternion = np.zeros(4)
        mujoco.mju_mat2Quat(quaternion, attitude.ravel())
        if name == "payload" and rig == "point":
            for axis, value in zip("xyz", position, strict=True):
                data.joint(f"payload/{axis}").qpos = value
        else:
            data.joint(name).qpos = [*position, *quaternion]
    mujoco.mj_kinematics(model, data)
    markers, met, drawn = [m for m in scene.markers if m.action == 0], 0, {"payload", *frames} - {"world"}
    assert {m.header.frame_id for m in markers} == drawn and all(m.frame_locked for m in markers)
    assert len({(m.ns, m.id) for m in markers}) == len(markers) and scene.markers[0].action == 3
    np.testing.assert_array_equal(frames["payload"][0], state.payload_position[0])
    for k in range(140):
        body = list(frames)[1 + k % (len(frames) - 1)]
        reach = 0.5 * np.linalg.norm(vec.world.system.payload_size) if body == "payload" else 0.2
        way = rng.standard_normal(3)
        way /= np.linalg.norm(way)
        origin = frames[body][0] + reach * rng.uniform(-0.6, 0.6, 3) - 4 * way
        found = np.zeros(1, np.int32)
        distance = mujoco.mj_ray(model, data, origin, way, None, 1, -1, found)
        ours = min(hit(marker, frames, origin, way) for marker in markers)
        if model.body(model.geom_bodyid[found[0]]).name in drawn:
            assert ours == pytest.approx(distance, abs=1e-6), (body, model.geom(found[0]).name)
            met += 1
        else:  # the ground, which is not drawn, or nothing
            assert ours > distance or distance < 0
    assert met > 50


@pytest.mark.slow
def test_a_gates_walls_are_drawn_and_their_gap_is_free(tmp_path):
    vec = make("gate", num_drones=3, **{"payload.mass": 1.0, "task_options.gates": 2})
    with BagWriter(tmp_path / "bag", vec):
        pass
    ((_, scene, _),) = read(tmp_path / "bag")["/scene"]
    walls = [marker for marker in scene.markers if marker.ns == "scenery" and marker.action == 0]
    world = {"world": (np.zeros(3), np.eye(3))}
    assert len(walls) == 6 and {marker.header.frame_id for marker in walls} == {"world"}
    rng = np.random.default_rng(0)
    for x, y, half in zip(vec.task.settings.x, vec.task.own.gap_y[0], vec.task.own.half_width[0], strict=True):
        for _ in range(200):
            aim = np.array([x, y + rng.uniform(-1.5, 1.5), rng.uniform(0.01, vec.task.settings.gap_height + 0.4)])
            met = min(hit(wall, world, aim - [1, 1e-9, 1e-9], np.array([1.0, 1e-9, 1e-9])) for wall in walls)
            is_wall = abs(aim[1] - y) > half or aim[2] > vec.task.settings.gap_height
            assert (met < 1.0) == is_wall, aim
    place_of = [place(wall.pose.position)[0] for wall in walls]
    np.testing.assert_allclose(sorted(set(place_of)), sorted(vec.task.settings.x))


def test_the_scene_is_sent_at_the_start_of_each_episode_and_each_second():
    vec = make(**TWO, **{"env.episode_seconds": 2.5})
    messages, sent = FlightMessages(vec, Wire.store), []
    for time in np.arange(0, 5.02, 0.02):
        if vec.ended[0]:
            vec.reset()
        elif time:
            vec.step(np.zeros((1, 2, 4)))
        if "/scene" in dict(messages.messages(round(time * 1e9))):
            sent.append(round(time, 2))
    assert sent == [0.0, 1.0, 2.0, 2.52, 3.52, 4.52]
    assert next(topic for topic in messages.topics() if topic.name == "/scene").latched


def test_a_mesh_of_many_faces_is_sent_once_an_episode(tmp_path):
    n = 72  # 2 n² triangles: a ball
    theta, phi = np.linspace(0, np.pi, n + 1), np.linspace(0, 2 * np.pi, n, endpoint=False)
    ball = [
        (0.2 * np.sin(t) * np.cos(p), 0.2 * np.sin(t) * np.sin(p), 0.2 * np.cos(t)) for t in theta[1:-1] for p in phi
    ]
    lines = [f"v {x} {y} {z}" for x, y, z in [(0, 0, 0.2), *ball, (0, 0, -0.2)]]

    def at(row: int, k: int) -> int:
        return 2 + row * n + k % n

    for k in range(n):
        lines += [f"f 1 {at(0, k)} {at(0, k + 1)}", f"f {len(ball) + 2} {at(n - 2, k + 1)} {at(n - 2, k)}"]
        for row in range(n - 2):
            lines.append(f"f {at(row, k)} {at(row + 1, k)} {at(row + 1, k + 1)}")
            lines.append(f"f {at(row, k)} {at(row + 1, k + 1)} {at(row, k + 1)}")
    (tmp_path / "ball.obj").write_text("\n".join(lines))
    vec = make(**TWO, **{"payload.shape": "mesh", "payload.mesh": str(tmp_path / "ball.obj")})
    messages = FlightMessages(vec, Wire.store)
    scene = dict(messages.messages(0))["/scene"]
    points = np.array([place(p) for m in scene.markers if m.type == TRIANGLES for p in m.points])
    assert len(points) == 3 * 2 * n * (n - 1) > _HEAVY
    np.testing.assert_allclose(np.linalg.norm(points, axis=1), 0.2, atol=1e-4)
    vec.step(np.zeros((1, 2, 4)))
    assert "/scene" not in dict(messages.messages(2_000_000_000))
    vec.reset()
    assert "/scene" in dict(messages.messages(2_020_000_000))


# The start, actions, covariances


def test_a_bag_begins_with_the_start_and_holds_the_actions(tmp_path):
    vec = make(**TWO)
    start, rng, actions = vec.world.state.payload_position[0].copy(), np.random.default_rng(0), []
    with BagWriter(tmp_path / "bag", vec) as bag:
        for step in range(5):
            actions.append(rng.uniform(-1.5, 1.5, (2, 4)))  # clipped to [-1, 1]
            vec.step(actions[-1][None])
            bag.write((step + 1) * vec.task.dt)
    heard = read(tmp_path / "bag")
    assert heard["/payload/odom"][0][0] == 0 and len(heard["/payload/odom"]) == 6
    np.testing.assert_array_equal(place(heard["/payload/odom"][0][1].pose.pose.position), start)
    for n in range(2):
        times, said, _ = zip(*heard[f"/drone_{n}/action"], strict=True)
        assert list(times) == [20_000_000 * (k + 1) for k in range(5)]
        for message, given in zip(said, actions, strict=True):
            np.testing.assert_array_equal(message.data, np.clip(given[n], -1, 1).astype(np.float32))
            (dimension,) = message.layout.dim
            assert dimension.label == "outward,sideways,up,yaw" and dimension.size == dimension.stride == 4


def test_covariances_have_inverses(tmp_path):
    vec = make(**TWO)
    with BagWriter(tmp_path / "bag", vec, names="report"):
        pass
    heard = read(tmp_path / "bag")
    odometry = heard["/payload_odom"][0][1]
    for covariance in (odometry.pose.covariance, odometry.twist.covariance):
        np.linalg.cholesky(np.reshape(covariance, (6, 6)))
        np.testing.assert_array_equal(np.diag(np.reshape(covariance, (6, 6))), EXACT)
    px4 = heard["/fmu/out/vehicle_odometry"][0][1]
    for variance in (px4.position_variance, px4.orientation_variance, px4.velocity_variance):
        assert (variance > 0).all() and np.isfinite(1 / variance).all()


def test_a_simulation_publishes_the_start_of_every_episode():
    vec = make(**TWO, **{"env.episode_seconds": 0.1})
    wire = Wire()
    live = LiveFlight(vec, wire, policy=make_scripted("formation", vec))
    live.begin(1)
    for _ in range(12):
        live.step()
    places = [place(message.pose.pose.position) for message in wire.sent["/payload/odom"]]
    times = [message.header.stamp.nanosec for message in wire.sent["/payload/odom"]]
    assert times == [20_000_000 * k for k in range(15)]  # 12 steps, and the starts of three episodes
    plain = make(**TWO, **{"env.episode_seconds": 0.1})
    for episode in range(3):
        np.testing.assert_array_equal(places[6 * episode], plain.world.state.payload_position[0])
        plain.reset()
    assert len(wire.sent["/drone_0/action"]) == 12
    assert not any("action" in topic.name for topic in FlightMessages(vec, Wire.store, acts=False).topics())


# Readers of others


def test_sqlite_reads_the_bag_of_humble(tmp_path):
    """The tables of rosbag2 by Python's own SQLite, and a message by its bytes (CDR, little-endian)."""
    vec = make(**TWO)
    with BagWriter(tmp_path / "bag", vec, "humble"):
        pass
    (file,) = (tmp_path / "bag").glob("*.db3")
    with sqlite3.connect(file) as bag:
        kinds = dict(bag.execute("SELECT name, type FROM topics").fetchall())
        rows = bag.execute(
            "SELECT timestamp, data FROM messages JOIN topics ON topic_id = topics.id WHERE name = '/payload/odom'"
        ).fetchall()
    assert kinds["/scene"] == "visualization_msgs/msg/MarkerArray"
    assert kinds["/drone_1/action"] == "std_msgs/msg/Float32MultiArray"
    ((time, data),) = rows
    assert time == 0 and data[:4] == b"\x00\x01\x00\x00"
    start = 4 + data[4:].index(b"payload\x00") + 8  # of the pose, aligned to 8 after the header's four bytes
    start += -(start - 4) % 8
    np.testing.assert_array_equal(np.frombuffer(data[start : start + 24], "<f8"), vec.world.state.payload_position[0])


def test_mcaps_own_reader_reads_the_bag_of_jazzy(tmp_path):
    """Foxglove's library, which decodes by the definitions that are stored in the bag."""
    reader = pytest.importorskip("mcap_ros2.reader")
    vec = make(**TWO)
    with BagWriter(tmp_path / "bag", vec) as bag:
        vec.step(np.full((1, 2, 4), 0.25))
        bag.write(vec.task.dt)
    (file,) = (tmp_path / "bag").glob("*.mcap")
    heard = {}
    for each in reader.read_ros2_messages(str(file)):
        heard.setdefault(each.channel.topic, []).append((each.log_time_ns, each.ros_msg))
    ours = read(tmp_path / "bag")
    assert {topic: len(messages) for topic, messages in heard.items()} == {t: len(m) for t, m in ours.items()}
    time, last = heard["/payload/odom"][-1]
    assert time == 20_000_000
    np.testing.assert_array_equal(place(last.pose.pose.position), vec.world.state.payload_position[0])
    np.testing.assert_array_equal(heard["/drone_1/action"][0][1].data, [0.25] * 4)
    theirs, own = heard["/scene"][0][1].markers, ours["/scene"][0][1].markers
    for one, other in zip(theirs, own, strict=True):
        assert (one.ns, one.id, one.type, one.header.frame_id) == (
            other.ns,
            other.id,
            other.type,
            other.header.frame_id,
        )
        np.testing.assert_array_equal(place(one.scale), place(other.scale))


def test_markers_of_obstacles_are_where_rays_meet_them(tmp_path):
    wedge = str(write_wedge(tmp_path / "wedge.obj"))
    around = [
        {"shape": "box", "size": [0.6, 0.4, 2.0], "position": [3, 0, 1], "rotation": [10, 20, 30]},
        {"shape": "cylinder", "size": [0.6, 1.5], "position": [-3, 0, 1], "rotation": [40, 0, 0]},
        {"shape": "sphere", "size": [0.5], "position": [0, 3, 1], "travel": [0.5, 0, 0], "period": 1.0},
        {"shape": "mesh", "mesh": wedge, "position": [0, -3, 1], "rotation": [0, 70, 0]},
    ]
    vec = make("hover", **TWO, **{"scene.obstacles": around})
    with BagWriter(tmp_path / "bag", vec) as writer:
        for k in range(10):
            vec.step(np.zeros((1, 2, 4)))
            writer.write(0.02 * (k + 1))
    heard = read(tmp_path / "bag")
    static = [m for m in heard["/scene"][0][1].markers if m.ns == "scenery"]
    moving = [m for m in heard["/markers"][-1][1].markers if m.ns == "scenery"]
    assert len(static) == len(moving) == 4
    obstacles, world = vec.world.obstacles, {"world": (np.zeros(3), np.eye(3))}
    assert place(static[2].pose.position)[0] == 0.0 and abs(place(moving[2].pose.position)[0]) > 0.3
    rng, met = np.random.default_rng(0), 0
    for k in range(120):
        m = k % 4
        way = rng.standard_normal(3)
        way /= np.linalg.norm(way)
        origin = obstacles.position[0, m] - 3.0 * way + 0.2 * rng.standard_normal(3)
        expected = ray_distance(0, m, tuple(origin), tuple(way), obstacles)
        found = hit(moving[m], world, origin, way)
        met += np.isfinite(found)
        assert found == pytest.approx(expected, abs=2e-5)
    assert met > 40
