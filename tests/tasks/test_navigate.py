"""Task navigate: maps from seeds, the straight line, what counts as a failure and as a success."""

import numpy as np
import pytest
from conftest import make, refusal, zeros

from multilift_marl.planning.maps import (
    CAPACITY,
    LEVELS,
    Course,
    draw_map,
    formation_height,
    formation_width,
    unit_length,
)
from multilift_marl.rig.obstacles import BOX, CYLINDER, NONE
from multilift_marl.sim.obstacles import clear_obstacles, place_obstacle
from multilift_marl.tasks.navigate import PEAK


def reset(num_envs: int = 2, **options):
    """Return environments at their starts; options of the task by name."""
    vec = make("navigate", num_envs=num_envs, **{f"task_options.{key}": value for key, value in options.items()})
    vec.reset(seed=0)
    return vec


@pytest.mark.parametrize("level", LEVELS)
@pytest.mark.parametrize("drones", [1, 2, 4, 8])
def test_maps_keep_starts_free_and_repeat(level, drones):
    system = make("hover", num_envs=1, num_drones=drones).world.system
    unit, width = unit_length(system), formation_width(system)
    for seed in range(20):
        drawn = draw_map(level, seed, system)
        again = draw_map(level, seed, system)
        assert drawn.obstacles == again.obstacles and np.array_equal(drawn.start, again.start)
        assert 0 < len(drawn.obstacles) <= CAPACITY
        for place in (drawn.start, drawn.goal):
            assert (drawn.low < place).all() and (place < drawn.high).all()
            for kind, size, position, _ in drawn.obstacles:
                # Walls are far along x; pillars may be anywhere in the field.
                away = abs(place[0] - position[0]) if kind == BOX and size[1] > unit else 9.0
                assert min(away, np.hypot(*(place - position)[:2])) > 0.5 * width
    assert draw_map(level, 0, system).obstacles != draw_map(level, 1, system).obstacles


def test_courses_have_their_length_and_their_number_of_pillars():
    system = make("hover", num_envs=1, num_drones=6).world.system
    unit, course = unit_length(system), Course(length=20.0, pillars=(8, 20))
    counts = set()
    for seed in range(60):
        drawn = draw_map("sparse", seed, system, course)
        counts.add(len(drawn.obstacles))
        along = np.array([each.position[0] for each in drawn.obstacles])
        assert np.abs(along).max() <= 8.6 * unit and drawn.goal[0] - drawn.start[0] == pytest.approx(20 * unit)
        assert (drawn.low < drawn.start).all() and (drawn.goal < drawn.high).all()
    assert min(counts) == 8 and max(counts) == 20
    assert course.capacity("sparse") == 20 and Course(length=20.0).capacity("sparse") == round(7 * 8.6 / 2.6)
    as_dense = len(draw_map("sparse", 0, system, Course(length=20.0)).obstacles)
    assert as_dense == Course(length=20.0).most_pillars("sparse")
    walls = [draw_map("narrow", 0, system, Course(length=length, walls=2)).obstacles for length in (8.0, 20.0)]
    assert len(walls[0]) == len(walls[1]) == 4 and Course(length=20.0).capacity("narrow") == CAPACITY


@pytest.mark.parametrize("walls", [1, 2, 3, 8])
def test_slots_are_as_high_as_asked_for_from_side_to_side(walls):
    system, course = make("hover", num_envs=1, num_drones=6).world.system, Course(walls=walls, slots=(0.9, 1.2))
    slots, half = system.slots, np.array([vehicle.half_size[2] for vehicle in system.vehicles])
    height = (slots[:, 2] + half).max() + system.payload_size[2] / 2 - system.payload_center[2]
    assert formation_height(system) == pytest.approx(height)
    shares = []
    for seed in range(30):
        drawn = draw_map("low", seed, system, course)
        assert len(drawn.obstacles) == 2 * walls <= CAPACITY
        for sill, beam in zip(drawn.obstacles[::2], drawn.obstacles[1::2], strict=True):
            assert sill.position[2] == sill.size[2] and sill.position[:2] == beam.position[:2]
            assert sill.size[:2] == beam.size[:2] and sill.size[1] >= -drawn.low[1] + 1.0
            opening = beam.position[2] - beam.size[2] - 2 * sill.size[2]
            shares.append(opening / height)
            assert beam.position[2] + beam.size[2] >= drawn.high[2] + system.slots[:, 2].max()
            assert 2 * sill.size[2] + system.payload_size[2] < drawn.high[2]
    assert 0.9 <= min(shares) < 0.92 and 1.18 < max(shares) <= 1.2


@pytest.mark.parametrize("size", [[0.4, 0.4, 0.8], [0.3, 0.3, 1.0], [0.4, 0.4, 0.1]])
def test_slots_leave_room_for_any_payload(size):
    """Over each sill below the ceiling, and below each beam, however low slots are asked for."""
    system = make("navigate_low", num_envs=1, **{"payload.size": size}).world.system
    for seed in range(100):
        drawn = draw_map("low", seed, system, Course(walls=2, slots=(0.1, 0.1)))
        for sill, beam in zip(drawn.obstacles[::2], drawn.obstacles[1::2], strict=True):
            edge = 2 * sill.size[2]
            assert edge + size[2] / 2 - system.payload_center[2] <= drawn.high[2] - 0.1 - 0.049
            assert beam.position[2] - beam.size[2] >= edge + size[2] + 0.15 * unit_length(system) - 1e-9


def test_one_drone_is_refused_where_cables_have_to_lean():
    said = refusal(make, "navigate_low", num_envs=1, num_drones=1, **{"payload.shape": "point"})
    assert "task_options.level=low needs two drones or more" in said


def test_a_goal_is_seen_no_farther_away_than_on_the_usual_course():
    for length, seen in ((8.0, None), (20.0, 9.0)):
        vec = make("navigate", num_envs=2, **{"task_options.length": length, "scene.reserved": 23})
        observation, _ = vec.reset(seed=0)
        at = vec.observation_names.index("to_goal_0")
        way = vec.task.own.goal - vec.task.goal.position
        far = np.linalg.norm(way, axis=1)
        expected = far if seen is None else seen * unit_length(vec.world.system)
        found = observation[..., at : at + 3]
        np.testing.assert_allclose(np.linalg.norm(found, axis=-1), np.broadcast_to(expected, (4, 2)).T, rtol=1e-6)
        np.testing.assert_allclose(found[..., 2], (way[:, 2] * expected / far)[:, None].repeat(4, 1), rtol=1e-4)


def test_environments_hold_the_maps_of_their_seeds():
    vec = reset(4)
    obstacles, own = vec.world.obstacles, vec.task.own
    assert len(set(own.map.tolist())) == 4
    for e, seed in enumerate(own.map.tolist()):
        drawn = draw_map("sparse", seed, vec.world.system)
        assert (obstacles.kind[e] != NONE).sum() == len(drawn.obstacles)
        for m, each in enumerate(drawn.obstacles):
            assert obstacles.kind[e, m] == each.kind
            assert np.array_equal(obstacles.position[e, m], each.position)
    only = reset(3, map=7).task.own
    assert (only.map == 7).all() and (only.start == only.start[0]).all()


def test_an_episode_is_the_same_in_any_batch():
    many, one = make("navigate", num_envs=5), make("navigate", num_envs=1, first_env=3)
    first = [vec.reset(seed=11)[0] for vec in (many, one)]
    assert np.array_equal(first[0][3], first[1][0])
    rng = np.random.default_rng(0)
    for _ in range(30):
        action = rng.uniform(-0.2, 0.2, zeros(many).shape)
        seen = many.step(action)[0][3], one.step(action[3:4])[0][0]
        assert np.array_equal(*seen)
    assert np.array_equal(many.task.clearance[3], one.task.clearance[0])


def test_the_target_moves_straight_at_its_speed():
    vec = reset(2, speed=1.0)
    clear_all(vec)
    own, task = vec.task.own, vec.task
    times = 0.02 * np.arange(1, 470)
    planned, _ = task.preview_targets(np.tile(times, (2, 1)))
    places = []
    for _ in times:
        vec.step(zeros(vec))
        places.append(task.goal.position.copy())
    np.testing.assert_allclose(np.array(places), planned.transpose(1, 0, 2), atol=1e-9)
    speed = np.linalg.norm(np.diff(places, axis=0), axis=2) / 0.02
    assert speed.max() == pytest.approx(1.0, abs=2e-3)
    way = own.goal - own.start
    assert np.allclose(np.cross(np.array(places) - own.start, way), 0, atol=1e-9)
    duration = PEAK * np.linalg.norm(way, axis=1)
    ends, _ = task.preview_targets(np.stack([np.zeros(2), duration], axis=1))
    np.testing.assert_allclose(ends, np.stack([own.start, own.goal], axis=1), atol=1e-12)


def clear_all(vec):
    """Take all obstacles away."""
    for e in range(vec.num_envs):
        clear_obstacles(e, vec.world.obstacles)
    vec.world.load(np.ones(vec.num_envs, bool))


def test_what_touches_fails_and_says_so():
    vec = reset(3)
    clear_all(vec)
    state, obstacles = vec.world.state, vec.world.obstacles
    drone, payload = state.drone_position[0, 1], state.payload_position[1]
    cable = 0.5 * (
        state.drone_position[2, 2] + state.payload_position[2] + state.payload_rotation[2] @ vec.task.rig.anchors[2]
    )
    for e, place in enumerate((drone, payload, cable)):
        place_obstacle(e, 3, obstacles, CYLINDER, (0.02, 0.02, 0.02), tuple(place))
    _, _, terminated, _, info = vec.step(zeros(vec))
    assert terminated.all()
    assert [vec.failure_causes[cause] for cause in info["failure_cause"]] == ["obstacle_collision"] * 3
    assert (vec.task.min_clearance == 0.0).all()


def test_clearance_is_the_least_distance():
    vec = reset(2)
    clear_all(vec)
    lowest = vec.world.state.payload_position[0, 2] - vec.world.system.payload_size[2] / 2
    place_obstacle(0, 0, vec.world.obstacles, BOX, (5, 5, 0.1), (-4, 0, lowest - 0.4))
    vec.step(zeros(vec))
    assert vec.task.clearance[0] == pytest.approx(0.3, abs=5e-3)
    assert vec.task.clearance[1] == 2.0


def test_a_payload_outside_the_map_is_out_of_range():
    vec = reset(2)
    vec.task.own.high[0, 1] = vec.task.own.start[0, 1] - 0.5
    _, _, terminated, _, info = vec.step(zeros(vec))
    assert terminated.tolist() == [True, False]
    assert vec.failure_causes[info["failure_cause"][0]] == "out_of_range"


def test_scenes_without_room_for_a_map_are_refused():
    assert "scene.reserved=16" in refusal(make, "navigate", **{"scene.reserved": 3})
    assert "scene.reserved=30" in refusal(make, "navigate", **{"task_options.pillars": [8, 30]})
    assert "scene.reserved=23" in refusal(make, "navigate", **{"task_options.length": 20})
    assert "pillars" in refusal(make, "navigate", **{"task_options.pillars": 3, "task_options.level": "narrow"})
    assert "pillars" in refusal(make, "navigate", **{"task_options.pillars": [8, 3]})


def test_a_given_way_has_a_length():
    place = {"task_options.level": "given", "scene.reserved": 0, "task_options.start": [0, 0, 1.5]}
    assert "less than 0.01 m apart" in refusal(make, "navigate", **place, **{"task_options.goal": [0, 0, 1.505]})
    make("navigate", **place, **{"task_options.goal": [0, 0, 1.52]}).reset()


def test_configured_obstacles_stay_beside_those_of_maps():
    beam = {"shape": "box", "size": [0.1, 0.1, 0.1], "position": [0, 0, 9]}
    vec = make("navigate", num_envs=2, **{"scene.obstacles": [beam]})
    for seed in (0, 1):
        vec.reset(seed=seed)
        assert (vec.world.obstacles.position[:, 0] == [0, 0, 9]).all()
        assert (vec.world.obstacles.kind[:, 1:6] != NONE).all()


PILLAR = {"shape": "cylinder", "size": [0.4, 4.0], "position": [0.0, 0.0, 2.0]}
GIVEN = {"task_options.level": "given", "task_options.start": [-3, 0, 1.5], "task_options.goal": [3, 1, 1.6]}
GIVEN |= {"scene.obstacles": [PILLAR], "scene.reserved": 0}


def test_a_given_map_is_the_scene_with_its_start_and_goal():
    vec = make("navigate", num_envs=2, **GIVEN)
    vec.reset(seed=0)
    own = vec.task.own
    assert (own.start == [-3, 0, 1.5]).all() and (own.goal == [3, 1, 1.6]).all()
    assert (vec.world.obstacles.kind == [[CYLINDER]]).all()
    np.testing.assert_allclose(own.low[0], [-5, -0.2 - 2, 0 - 2])
    np.testing.assert_allclose(own.high[0], [5, 1 + 2, 4 + 2])
    vec = make("navigate", num_envs=1, **GIVEN, **{"task_options.low": [-4, -1, 1], "task_options.high": [4, 2, 2]})
    vec.reset(seed=0)
    assert vec.task.own.low[0].tolist() == [-4, -1, 1] and vec.task.own.high[0].tolist() == [4, 2, 2]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"task_options.goal": None}, "needs task_options.start and task_options.goal"),
        ({"task_options.level": "dense", "scene.reserved": 16}, "task_options.start means nothing at level dense"),
        ({"task_options.high": [2, 2, 2]}, r"goal=[3.0, 1.0, 1.6] is outside the payload's space"),
        ({"task_options.goal": [0.3, 0, 1.5]}, "at task_options.goal=[0.3, 0.0, 1.5] the team is in an obstacle"),
        ({"task_options.start": [1, 2]}, "task_options.start"),
        ({"task_options.pillars": 3}, "task_options.pillars means nothing at level given"),
        ({"task_options.map": 3}, "task_options.map means nothing at level given"),
    ],
)
def test_given_maps_that_cannot_be_are_refused(change, said):
    assert said in refusal(make, "navigate", **(GIVEN | change))


def test_what_an_episode_misses_is_the_distance_from_the_goal():
    """Not from the target, which is under way."""
    vec = reset(2, speed=0.5)
    clear_all(vec)
    (criterion,) = (each for each in vec.task.criteria() if each.name == "distance_m")
    vec.step(zeros(vec))
    away = np.linalg.norm(vec.world.state.payload_position - vec.task.own.goal, axis=1)
    assert vec.task.errors.distance.max() < 0.5 < away.min()
    np.testing.assert_allclose(criterion.excess(), away - criterion.bound, atol=1e-12)


def test_a_straight_flight_without_obstacles_succeeds():
    vec = reset(2)
    clear_all(vec)
    for _ in range(vec.max_steps):
        _, _, terminated, truncated, info = vec.step(zeros(vec))
        if (terminated | truncated).any():
            break
    assert truncated.all() and vec.task.own.peak_tension.max() < 1.5
    assert info["success"].all()
