"""Shipped rigs, and payloads of other shapes with their centre of mass anywhere."""

from __future__ import annotations

import itertools
import re
from dataclasses import fields

import mujoco
import numpy as np
import pytest
from conftest import hover_thrust, level, load, make, make_system, refuse_system, same

import multilift_marl as ml
from multilift_marl.config.load import list_configs
from multilift_marl.control.scripted import make_scripted
from multilift_marl.math3d import axis_angle
from multilift_marl.rig.mesh import read_mesh
from multilift_marl.sim import World
from multilift_marl.sim.scene import build_model
from multilift_marl.tasks.failures import CAUSES, payload_height

RIGS = [name for name in list_configs() if name.startswith("rigs/")]
SIZES = {"falcon4": 4, "falcon3": 3, "crazyflie2": 2, "auto6": 6, "report4": 4}
SHIFT = (0.06, -0.04, -0.05)
SHIFTED = {"payload.center_of_mass": SHIFT}
DISC = {"payload.shape": "cylinder", "payload.size": (0.8, 0.8, 0.2)}

# Rigs


def test_rigs_are_shipped_with_their_number_of_drones():
    assert {name.removeprefix("rigs/"): ml.load_config(name).env.num_drones for name in RIGS} == SIZES


def test_falcon4_is_the_default_rig():
    rig, default = ml.load_config("rigs/falcon4").system, ml.load_config("hover").system
    for field in fields(rig):
        first, second = getattr(rig, field.name), getattr(default, field.name)
        if isinstance(first, np.ndarray):
            np.testing.assert_allclose(first, second, rtol=1e-12, atol=1e-15, err_msg=field.name)
        else:
            assert first == second, field.name


@pytest.mark.parametrize(
    ("recipe", "rig"), [("track_auto6", "auto6"), ("pose_falcon3", "falcon3"), ("recover_crazymarl", "crazyflie2")]
)
def test_recipes_that_repeat_a_rig_say_the_same(recipe, rig):
    trained, shipped = ml.load_config(recipe), ml.load_config(f"rigs/{rig}")
    assert trained.env.num_drones == shipped.env.num_drones
    for section in ("vehicle", "payload", "cable"):
        assert getattr(trained, section) == getattr(shipped, section)


@pytest.mark.slow
@pytest.mark.parametrize("name", RIGS)
def test_scripted_teams_fly_every_rig(name):
    vec = ml.make_vec(name, num_envs=8, num_threads=1)
    assert vec.num_drones == SIZES[name.removeprefix("rigs/")]
    for script in ("formation", "formation_integral"):
        policy = make_scripted(script, vec)
        observation, _ = vec.reset(seed=1)  # one start of seed 0 is at the limit of the cables' angle (report4)
        for _ in range(vec.max_steps):
            observation, _, terminated, truncated, info = vec.step(policy.act(observation).astype(float))
            assert not terminated.any(), [CAUSES[cause] for cause in info["failure_cause"]]
        assert truncated.all()
    assert info["success"].mean() >= 7 / 8
    assert vec.task.errors.distance.mean() < 0.03


@pytest.mark.parametrize("name", RIGS)
def test_rigs_can_be_drawn(name):
    model, layout = build_model(ml.load_config(name).system, visuals=True)
    assert model.nbody == SIZES[name.removeprefix("rigs/")] + 3  # world, payload, target
    assert layout.payload_body == 1


def test_auto6_pulls_hardest_beside_its_centre_of_mass():
    system = ml.load_config("rigs/auto6").system
    tension = np.linalg.norm(system.formation_force, axis=1)
    nearness = system.anchors[:, :2] @ np.array([0.1, 0.1])
    assert np.corrcoef(tension, nearness)[0, 1] > 0.95


# Centre of mass


@pytest.mark.parametrize("shape", [{}, DISC], ids=["box", "cylinder"])
def test_anchors_are_given_from_the_geometric_centre(shape):
    system, plain = make_system(4, **SHIFTED, **shape), make_system(4, **shape)
    np.testing.assert_allclose(system.anchors, plain.anchors - np.array(SHIFT), atol=1e-15)
    np.testing.assert_allclose(system.payload_center, -np.array(SHIFT), atol=1e-15)


@pytest.mark.parametrize("shape", [{}, DISC], ids=["box", "cylinder"])
def test_pulls_balance_the_weight_about_the_centre_of_mass(shape):
    system = make_system(4, **SHIFTED, **shape)
    np.testing.assert_allclose(system.formation_force.sum(axis=0), [0, 0, 9.81 * system.payload_mass], atol=1e-9)
    np.testing.assert_allclose(np.cross(system.anchors, system.formation_force).sum(axis=0), 0, atol=1e-9)


@pytest.mark.parametrize("shape", [{}, DISC], ids=["box", "cylinder"])
def test_a_payload_with_its_mass_off_centre_rests_in_formation(shape):
    vec = make(num_envs=1, **SHIFTED, **shape)
    level(vec)
    world = vec.world
    world.step(hover_thrust(world), 50)
    assert np.abs(world.state.payload_velocity).max() < 2e-3
    assert np.abs(world.state.payload_body_rates).max() < 5e-3
    np.testing.assert_allclose(
        world.state.cable_tension[0], np.linalg.norm(world.system.formation_force, axis=1), rtol=0.01
    )


def test_a_payload_pulled_along_its_centre_of_mass_does_not_turn():
    system = make_system(1, **{"cable.length": 20.0, "payload.anchors": [SHIFT], **SHIFTED})
    world = World(system, 1, 1)
    world.state.payload_position[:], world.state.drone_position[:] = [0, 0, 100], [0, 0, 102]
    load(world)
    world.hidden_loads.payload_force[:] = [5.0, 2.0, 0.0]
    world.step(np.zeros((1, 1, 4)), 100)
    assert np.abs(world.state.payload_velocity).max() > 1
    assert np.abs(world.state.payload_body_rates).max() < 1e-9


def test_point_is_its_own_centre():
    message = refuse_system(payload__shape="point", payload__center_of_mass=SHIFT)
    assert re.match(r"payload\.center_of_mass means nothing to a point; drop it", message)


def test_centre_of_mass_outside_the_payload():
    message = refuse_system(payload__center_of_mass=[0.0, 0.0, 0.2])
    assert re.match(r"payload\.center_of_mass \[0\.0, 0\.0, 0\.2\] lies outside the payload", message)


@pytest.mark.parametrize("shape", [{}, DISC], ids=["box", "cylinder"])
def test_the_lowest_point_is_that_of_the_surface(shape):
    vec = make("hover", num_envs=1, **shape)
    limits, system = vec.task.view.limits, vec.world.system
    if shape:
        angle = np.linspace(0, 2 * np.pi, 20001)
        rim = 0.5 * np.stack([np.cos(angle), np.sin(angle), np.ones_like(angle)], axis=1) * system.payload_size
        points = np.concatenate([rim, rim * [1, 1, -1]])
    else:
        points = 0.5 * np.array(list(itertools.product((-1, 1), repeat=3))) * system.payload_size
    rng = np.random.default_rng(0)
    for _ in range(20):
        axis = rng.normal(size=3)
        attitude = np.reshape(axis_angle(tuple(axis / np.linalg.norm(axis)), rng.uniform(0, np.pi)), (3, 3))
        place = rng.normal(size=3)
        lowest = (place + (points + system.payload_center) @ attitude.T)[:, 2].min()
        assert payload_height(tuple(place), tuple(attitude.ravel()), limits) == pytest.approx(lowest, abs=1e-6)


def test_centre_of_mass_outside_a_cylinder_but_inside_its_box():
    disc = {"payload__shape": "cylinder", "payload__size": (0.8, 0.8, 0.2)}
    assert "lies outside" in refuse_system(**disc, payload__center_of_mass=(0.35, 0.35, 0.0))


# Cylinder


def test_cylinder_inertia_is_that_of_a_uniform_cylinder():
    system = make_system(4, **DISC, **{"payload.mass": 1.2})
    across = 1.2 * (3 * 0.4**2 + 0.2**2) / 12
    np.testing.assert_allclose(system.payload_inertia, [across, across, 1.2 * 0.4**2 / 2])


@pytest.mark.parametrize("shape", [{}, DISC], ids=["box", "cylinder"])
def test_inertia_and_volume_agree_with_mujoco(shape):
    system = make_system(4, **shape)
    model, _ = build_model(system)
    spec = mujoco.MjSpec()
    body, geom = spec.worldbody.add_body(), model.geom("payload")
    body.add_geom(type=int(geom.type[0]), size=geom.size, mass=system.payload_mass)
    np.testing.assert_allclose(np.sort(spec.compile().body_inertia[1]), np.sort(system.payload_inertia), rtol=1e-6)


def test_cylinder_needs_one_diameter():
    message = refuse_system(payload__shape="cylinder", payload__size=[0.8, 0.6, 0.2])
    assert re.match(r"payload\.size .* of a cylinder must give its diameter twice, then its height; make", message)


@pytest.mark.parametrize("count", [2, 3, 4, 6])
def test_standard_cylinder_carries_its_anchors_on_a_ring(count):
    system = make_system(count, **{"payload.shape": "cylinder"})
    radius = np.hypot(system.anchors[:, 0], system.anchors[:, 1])
    np.testing.assert_allclose(radius, radius[0])
    assert radius[0] <= system.payload_size[0] / 2 + 1e-12


@pytest.mark.parametrize("tilt", [0.0, 0.2, 0.9])
@pytest.mark.parametrize("azimuth", [0.0, 0.8])
@pytest.mark.parametrize("shape", [{}, DISC], ids=["box", "cylinder"])
def test_ground_is_touched_where_the_body_is(shape, tilt, azimuth):
    vec = make(num_envs=1, **SHIFTED, **shape, **{"cable.length": 3.0})
    vec.reset(seed=0)
    state, system = vec.world.state, vec.world.system
    rotation = np.reshape(axis_angle((float(np.cos(azimuth)), float(np.sin(azimuth)), 0.0), tilt), (3, 3))
    half = system.payload_size / 2
    if shape:
        around = np.linspace(0, 2 * np.pi, 100_000)
        rim = np.stack([half[0] * np.cos(around), half[0] * np.sin(around)], axis=1)
        points = np.concatenate([np.c_[rim, np.full(len(rim), z)] for z in (-half[2], half[2])])
    else:
        points = half * np.array(np.meshgrid(*[[-1, 1]] * 3)).reshape(3, -1).T
    below = -((points + system.payload_center) @ rotation.T)[:, 2].min()
    for height, touches in ((0.004, True), (0.006, False)):
        state.payload_rotation[0], state.payload_position[0] = rotation, [0, 0, below + height]
        vec.task.goal.position[0] = state.payload_position[0]
        vec.task.stages["measure"](0, 1)
        assert (CAUSES[vec.task.cause[0]] == "ground") == touches


@pytest.mark.parametrize("shape", [{}, DISC], ids=["box", "cylinder"])
def test_what_is_drawn_and_touched_stands_about_the_geometric_centre(shape):
    model, _ = build_model(make_system(4, **SHIFTED, **shape), visuals=True)
    target = model.geom_bodyid == model.body("target").id
    np.testing.assert_allclose(model.geom("payload").pos, -np.array(SHIFT))
    np.testing.assert_allclose(model.geom_pos[target].mean(axis=0), -np.array(SHIFT), atol=1e-9)


def test_seeded_flights_of_a_cylinder_repeat():
    def flight():
        vec = make(num_envs=2, **SHIFTED, **DISC)
        vec.reset(seed=1)
        return [vec.step(np.full((2, 4, 4), 0.3))[0].copy() for _ in range(20)]

    assert same(flight(), flight())


# Mesh

WEDGE = "v 0 0 0\nv 0.6 0 0\nv 0 0.8 0\nv 0 0 0.3\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
FLAT = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"


@pytest.fixture
def wedge(write):
    """Return overrides for a tetrahedron with three edges along the axes from its corner."""
    anchors = [[0.0, -0.05, 0.1], [-0.28, -0.05, 0.1], [-0.28, -0.35, 0.1], [0.0, -0.35, 0.1]]
    return {"payload.shape": "mesh", "payload.mesh": str(write(WEDGE, "wedge.obj")), "payload.anchors": anchors}


def test_uniform_mesh_has_the_centre_and_inertia_of_its_volume(wedge):
    system = make_system(4, **wedge, **{"payload.mass": 2.0})
    edges = np.array([0.6, 0.8, 0.3])
    np.testing.assert_allclose(system.payload_size, edges)
    np.testing.assert_allclose(system.payload_center, edges / 4, atol=1e-7)  # its mass lies a quarter up each edge
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, system.payload_axes)
    axes = rotation.reshape(3, 3)
    second = 2.0 * (4 * np.diag(edges**2) - np.outer(edges, edges)) / 80
    inertia = np.trace(second) * np.eye(3) - second
    np.testing.assert_allclose(axes @ np.diag(system.payload_inertia) @ axes.T, inertia, atol=1e-6)


def test_mesh_is_scaled_to_its_size_and_keeps_what_is_given(wedge):
    given = {"payload.size": (0.6, 0.8, 0.2), "payload.inertia": (0.01, 0.011, 0.012)}
    given["payload.center_of_mass"] = (-0.1, -0.2, 0.0)
    system = make_system(4, **wedge, **given)
    np.testing.assert_allclose(system.payload_size, [0.6, 0.8, 0.2])
    np.testing.assert_allclose(system.payload_inertia, [0.01, 0.011, 0.012])
    assert system.payload_axes.tolist() == [1, 0, 0, 0]
    np.testing.assert_allclose(system.payload_center, [0.1, 0.2, 0.0])


def test_mesh_stands_where_its_file_says_and_flies(wedge):
    vec = make(num_envs=2, **wedge)
    system = vec.world.system
    model, _ = build_model(system, visuals=True)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    geom, mesh = model.geom("payload").id, model.geom("payload").dataid[0]
    count = model.mesh_vertnum[mesh]
    vertices = model.mesh_vert[model.mesh_vertadr[mesh] :][:count]
    points = vertices @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom] - data.body("payload").xpos
    np.testing.assert_allclose(points.min(axis=0), system.payload_center - system.payload_size / 2, atol=1e-6)
    np.testing.assert_allclose(points.max(axis=0), system.payload_center + system.payload_size / 2, atol=1e-6)
    policy = make_scripted("formation", vec)
    observation, _ = vec.reset(seed=0)
    for _ in range(200):
        observation, _, terminated, _, _ = vec.step(policy.act(observation).astype(float))
        assert not terminated.any()


def obj(points, faces):
    lines = [f"v {x:.17g} {y:.17g} {z:.17g}" for x, y, z in points] + [
        f"f {a + 1} {b + 1} {c + 1}" for a, b, c in faces
    ]
    return "\n".join(lines) + "\n"


def stl(points, faces):
    """Return a binary .stl file, in which every triangle has vertices of its own."""
    facets = np.zeros(len(faces), [("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("more", "<u2")])
    facets["corners"] = points[faces]
    return bytes(80) + np.uint32(len(faces)).tobytes() + facets.tobytes()


def cells(lines, filled):
    """Return the surface of the boxes between coordinate lines of x and y, extruded from 0 to the last of `lines`."""
    xs, ys, height = lines
    corner = {}

    def number(*at):
        return corner.setdefault(at, len(corner))

    faces = []

    def square(*around):
        a, b, c, d = (number(*at) for at in around)
        faces.extend([(a, b, c), (a, c, d)])

    for i, j in filled:
        square((i, j, 0), (i, j + 1, 0), (i + 1, j + 1, 0), (i + 1, j, 0))
        square((i, j, 1), (i + 1, j, 1), (i + 1, j + 1, 1), (i, j + 1, 1))
        if (i - 1, j) not in filled:
            square((i, j, 0), (i, j, 1), (i, j + 1, 1), (i, j + 1, 0))
        if (i + 1, j) not in filled:
            square((i + 1, j, 0), (i + 1, j + 1, 0), (i + 1, j + 1, 1), (i + 1, j, 1))
        if (i, j - 1) not in filled:
            square((i, j, 0), (i + 1, j, 0), (i + 1, j, 1), (i, j, 1))
        if (i, j + 1) not in filled:
            square((i, j + 1, 0), (i, j + 1, 1), (i + 1, j + 1, 1), (i + 1, j + 1, 0))
    return np.array([(xs[i], ys[j], k * height) for i, j, k in corner]), np.array(faces)


def union(lines, filled):
    """Return centre of mass (3,) and inertia about it (3, 3) of 1 kg of those boxes, in closed form."""
    xs, ys, height = lines
    edges = np.array([(xs[i + 1] - xs[i], ys[j + 1] - ys[j], height) for i, j in filled])
    middles = np.array([((xs[i + 1] + xs[i]) / 2, (ys[j + 1] + ys[j]) / 2, height / 2) for i, j in filled])
    share = edges.prod(axis=1) / edges.prod(axis=1).sum()
    center = share @ middles
    second = sum(
        m * (np.diag(edge**2) / 12 + np.outer(place - center, place - center))
        for m, edge, place in zip(share, edges, middles, strict=True)
    )
    return center, np.trace(second) * np.eye(3) - second


def ring(sides, outer, inner, height):
    """Return the surface of a ring between two regular polygons, its centre of mass and its inertia per kg."""
    angle = 2 * np.pi * np.arange(sides) / sides
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    points = np.concatenate(
        [np.c_[radius * circle, np.full(sides, z)] for z in (0, height) for radius in (inner, outer)]
    )
    faces = []
    for k in range(sides):
        a, b = k, (k + 1) % sides
        for p, q, _, s in ((0, 1, 1, 0), (1, 3, 3, 1), (3, 2, 2, 3), (2, 0, 0, 2)):  # below, outside, above, inside
            faces += [(p * sides + a, q * sides + b, q * sides + a), (p * sides + a, s * sides + b, q * sides + b)]
    area, polar = 0.0, 0.0
    for radius, sign in ((outer, 1), (inner, -1)):
        part = sign * sides / 2 * radius**2 * np.sin(2 * np.pi / sides)
        area, polar = area + part, polar + part * radius**2 * (2 + np.cos(2 * np.pi / sides)) / 6
    across, along = polar / area / 2 + height**2 / 12, polar / area
    return (points, np.array(faces)), (np.array([0, 0, height / 2]), np.diag([across, across, along]))


ELL = ((0.0, 0.2, 0.6), (0.0, 0.2, 0.5), 0.15), {(0, 0), (1, 0), (0, 1)}
CHANNEL = ((0.0, 0.1, 0.5, 0.6), (0.0, 0.1, 0.7), 0.2), {(0, 0), (1, 0), (2, 0), (0, 1), (2, 1)}
CONCAVE = {
    "ell": (cells(*ELL), union(*ELL)),
    "channel": (cells(*CHANNEL), union(*CHANNEL)),
    "ring": ring(24, 0.5, 0.4, 0.1),
}


@pytest.mark.parametrize("form", [obj, stl], ids=["obj", "stl"])
@pytest.mark.parametrize("name", CONCAVE)
def test_concave_meshes_have_the_centre_and_inertia_of_their_matter(name, form, tmp_path):
    (points, faces), (center, inertia) = CONCAVE[name]
    turn = np.reshape(axis_angle((0.6, 0.0, 0.8), 0.5), (3, 3))  # so that no principal axis is one of the file's
    path, content = tmp_path / f"body.{form.__name__}", form(points @ turn.T, faces)
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    mesh = read_mesh(str(path))
    np.testing.assert_allclose(mesh.center_of_mass, turn @ center, atol=1e-6)
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, mesh.axes)
    axes = rotation.reshape(3, 3)
    np.testing.assert_allclose(axes @ np.diag(mesh.inertia) @ axes.T, turn @ inertia @ turn.T, atol=1e-7)


@pytest.mark.parametrize(
    "text, name, complaint",
    [
        (None, "none.obj", r"payload\.mesh=.* is missing, there is no /.*none\.obj; correct the path"),
        (WEDGE, "wedge.txt", r"payload\.mesh=.* is no \.obj or \.stl file"),
        (FLAT, "flat.obj", r"payload\.mesh=.* cannot be a body \(.*\); give a closed surface"),
        ("nonsense", "bad.stl", r"payload\.mesh=.* cannot be a body \(.*\); give a closed surface"),
        (
            obj(CONCAVE["ell"][0][0], CONCAVE["ell"][0][1][:-1]),
            "open.obj",
            r"payload\.mesh=.* has holes, so close them",
        ),
        (obj(CONCAVE["ell"][0][0], CONCAVE["ell"][0][1][:, ::-1]), "in.obj", r"payload\.mesh=.* faces look inwards"),
        (
            obj(CONCAVE["ell"][0][0], [*CONCAVE["ell"][0][1][:-1], CONCAVE["ell"][0][1][-1][::-1]]),
            "mixed.obj",
            r"payload\.mesh=.* neighbouring faces look to different sides",
        ),
    ],
)
def test_a_file_that_holds_no_body_is_refused(text, name, complaint, write, tmp_path):
    path = tmp_path / name if text is None else write(text, name)
    message = refuse_system(payload__shape="mesh", payload__mesh=str(path))
    assert re.match(complaint, message), message


def test_mesh_and_its_shape_belong_together():
    assert re.match(r"payload\.shape=mesh needs payload\.mesh; give the path", refuse_system(payload__shape="mesh"))
    assert re.match(r"payload\.mesh means nothing to a box; drop it or use", refuse_system(payload__mesh="a.obj"))
