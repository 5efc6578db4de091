"""Teams of different vehicles: each drone has its own numbers everywhere, and carries what it can."""

from __future__ import annotations

import re

import mujoco
import numpy as np
import pytest
from conftest import drone_gains, floats, load, make, make_system, refuse_system, same, zeros

import multilift_marl as ml
from multilift_marl.control.gains import make_gains
from multilift_marl.policies.baselines import make_scripted
from multilift_marl.rig.balance import formation_forces
from multilift_marl.rig.presets import PRESETS
from multilift_marl.schema.control import ControlConfig
from multilift_marl.sim import World
from multilift_marl.sim.air import make_air, wash_at
from multilift_marl.sim.contact import drone_half_size
from multilift_marl.sim.scene import build_model

MIX = ["falcon", "falcon", "hummingbird", "iris"]
ALL = sorted(PRESETS)
POINT = {"payload.shape": "point", "payload.mass": 0.005, "cable.length": 90.0}
APART = POINT | {"vehicle.rolling_moment": 1e-6, "wind.ground_effect": True}
MODELS = ("massless", "chain")


def spare(names: list[str]) -> np.ndarray:
    return np.array([PRESETS[name].spare_lift for name in names])


# The system


def test_each_drone_has_its_own_vehicle_in_system_and_model():
    system = make_system(4, **{"vehicle.preset": MIX})
    assert [vehicle.name for vehicle in system.vehicles] == MIX
    model, layout = build_model(system)
    bodies = list(layout.drone_bodies)
    np.testing.assert_array_equal(model.body_mass[bodies], [PRESETS[name].mass for name in MIX])
    np.testing.assert_array_equal(model.body_inertia[bodies], [PRESETS[name].inertia for name in MIX])
    with pytest.raises(ValueError, match="not alike"):
        _ = system.vehicle


def test_other_fields_may_be_lists_too():
    inertia = [[2e-3, 2e-3, 3e-3], [3e-3, 3e-3, 4e-3]]
    overrides = {"vehicle.mass": [0.7, 0.9], "vehicle.inertia": inertia, "vehicle.drag": [0.1, 0.1, 0.0]}
    first, second = make_system(2, **overrides, **{"payload.shape": "point"}).vehicles
    assert (first.mass, second.mass) == (0.7, 0.9)
    assert (first.inertia, second.inertia) == ((2e-3, 2e-3, 3e-3), (3e-3, 3e-3, 4e-3))
    assert first.drag == second.drag == (0.1, 0.1, 0.0)


def test_a_list_of_equal_presets_is_that_preset_bit_for_bit():
    def flown(preset):
        vec = make("hover", num_envs=2, **{"vehicle.preset": preset})
        seen = [vec.reset(seed=1)[0]]
        return seen + [vec.step(zeros(vec) + 0.3)[0] for _ in range(20)]

    assert same(flown("hummingbird"), flown(["hummingbird"] * 4))


def test_standard_payload_is_the_sum_of_what_each_would_carry():
    each = [make_system(1, **{"vehicle.preset": name}).payload_mass for name in MIX]
    assert make_system(4, **{"vehicle.preset": MIX}).payload_mass == pytest.approx(sum(each), rel=1e-12)


def test_standard_rig_follows_the_mean_span_and_limits_follow_each_pair():
    system = make_system(4, **{"vehicle.preset": MIX})
    span = np.array([PRESETS[name].span for name in MIX])
    np.testing.assert_allclose(system.cable_length, span.mean() / PRESETS["falcon"].span)
    np.testing.assert_allclose(system.min_separation, 0.35 * (span[:, None] + span) / 2 / PRESETS["falcon"].span)


# The formation


@pytest.mark.parametrize("names", [MIX[1:], ["crazyflie_id", "falcon"], ["iris", "falcon", "hummingbird"] * 2])
def test_drones_share_a_point_payload_by_their_spare_lift(names):
    system = make_system(len(names), **{"vehicle.preset": names, "payload.shape": "point", "cable.length": 3.0})
    share = system.formation_force[:, 2] / spare(names)
    np.testing.assert_allclose(share, share[0], rtol=1e-9)
    np.testing.assert_allclose(system.formation_force.sum(axis=0), [0, 0, system.payload_mass * 9.81], atol=1e-9)


@pytest.mark.parametrize("weak", range(5))
def test_a_weak_drone_carries_less_of_a_body_whose_weight_and_moments_stay_balanced(weak):
    around = 2 * np.pi * np.arange(5) / 5
    anchors = np.stack([0.4 * np.cos(around), 0.3 * np.sin(around), np.full(5, 0.08)], axis=1)
    strength = np.where(np.arange(5) == weak, 0.6, 1.1)
    even, force = (formation_forces(anchors, 20.0, np.deg2rad(30), False, s) for s in (np.ones(5), strength))
    assert force[weak, 2] < 0.9 * even[weak, 2]
    assert np.delete(force[:, 2], weak).sum() > np.delete(even[:, 2], weak).sum()
    np.testing.assert_allclose(force.sum(axis=0), [0, 0, 20], atol=1e-9)
    np.testing.assert_allclose(np.cross(anchors, force).sum(axis=0), 0, atol=1e-9)


# Physics and control


@pytest.mark.slow
def test_each_drone_of_a_mixed_team_moves_as_it_does_alone():
    rng = np.random.default_rng(0)
    thrust = rng.uniform(0.2, 0.8, (len(ALL), 4)) * [[PRESETS[name].rotor_thrust_max] for name in ALL]
    places = np.array([[3.0 * n, 0.0, 0.1 + 0.1 * n] for n in range(len(ALL))])

    def moved(names, chosen):
        system = make_system(len(names), **{"vehicle.preset": names}, **APART)
        world = World(system, 1, 1)
        world.state.payload_position[0] = [6, 40, 1]
        world.state.drone_position[0], world.state.drone_rotation[:] = places[chosen], np.eye(3)
        world.state.rotor_speed[:] = 500.0
        load(world)
        world.step(thrust[chosen][None], 25)
        return world.state.drone_position[0], world.state.drone_rotation[0], world.state.rotor_speed[0]

    team = moved(ALL, list(range(len(ALL))))
    for n, name in enumerate(ALL):
        for together, alone in zip(team, moved([name], [n]), strict=True):
            np.testing.assert_allclose(together[n], alone[0], rtol=1e-9, atol=1e-12)


def test_each_drone_blows_its_own_wash():
    names = ["falcon", "iris"]

    def below(names, n, offset):
        system = make_system(len(names), **{"vehicle.preset": names, "wind.wash": True}, **POINT)
        world = World(system, 1, 1)
        world.state.drone_position[0] = [[50.0 * i, 0.0, 20.0] for i in range(len(names))]
        c, place = make_air(world.system), (50.0 * n + offset, 0.0, 19.0)
        world.state.rotor_speed[:], world.state.drone_rotation[:] = 700.0, np.eye(3)
        return wash_at(0, place, 0.05, world.state, c)

    for n, name in enumerate(names):
        assert below(names, n, 0.1)[2] == pytest.approx(below([name], 0, 0.1)[2], rel=1e-12)
    assert below(names, 0, 0.1)[2] != pytest.approx(below(names, 1, 0.1)[2], rel=0.05)


def test_each_drone_is_controlled_by_the_gains_of_its_vehicle():
    names = ["crazyflie_id", *MIX[1:]]
    mixed = make_gains(
        ControlConfig(), make_system(4, **{"vehicle.preset": names, "payload.shape": "point", "cable.length": 3.0})
    )
    for n, name in enumerate(names):
        alone = drone_gains(make_gains(ControlConfig(), make_system(1, **{"vehicle.preset": name})), 0)
        own = drone_gains(mixed, n)
        for field in set(own._fields) - {"load_share"}:
            np.testing.assert_array_equal(getattr(own, field), getattr(alone, field), err_msg=field)


# Flight


def fly(vec, script: str) -> tuple[np.ndarray, np.ndarray]:
    """Return which teams (E,) succeeded and which failed in their first episodes."""
    policy, (observation, _) = make_scripted(script, vec), vec.reset(seed=1000)
    failed = np.zeros(vec.num_envs, bool)
    for _ in range(vec.max_steps):
        observation, _, terminated, _, info = vec.step(policy.act(observation))
        failed |= terminated
        if terminated.any():
            observation, _ = vec.reset(mask=terminated)
    return info["success"] & ~failed, failed


@pytest.mark.slow
@pytest.mark.parametrize("model, teams", [("massless", 16), ("chain", 2)])
def test_a_mixed_team_hovers(model, teams):
    def vec():
        return make("hover", num_envs=teams, **{"vehicle.preset": MIX, "cable.model": model})

    assert not fly(vec(), "formation")[1].any()
    success, failed = fly(vec(), "formation_integral")
    assert success.mean() > 0.9 and not failed.any()


@pytest.mark.slow
@pytest.mark.parametrize("model", MODELS)
def test_mixed_teams_are_deterministic_and_can_be_saved(model):
    def vec(num_threads=1, num_envs=3):
        config = {"vehicle.preset": MIX, "cable.model": model}
        return make("hover", num_envs=num_envs, num_threads=num_threads, **config)

    def flown(vec, steps):
        actions = np.random.default_rng(0).uniform(-1, 1, (steps, 1, 4, vec.action_size)).repeat(vec.num_envs, axis=1)
        return [vec.step(action)[:4] for action in actions]

    first, second = vec(), vec(num_threads=2)
    assert same(first.reset(seed=5)[0], second.reset(seed=5)[0])
    seen = flown(first, 12)
    assert same(seen, flown(second, 12))
    restored = vec()
    restored.reset(seed=9)
    restored.load_state_dict(first.state_dict())
    assert same(flown(first, 12), flown(restored, 12))


# Drawing


def test_each_vehicle_is_drawn_in_its_own_size():
    system = make_system(4, **{"vehicle.preset": MIX})
    model, _ = build_model(system, visuals=True)
    discs = model.geom_type == mujoco.mjtGeom.mjGEOM_CYLINDER
    for n, vehicle in enumerate(system.vehicles):
        np.testing.assert_allclose(model.geom(f"drone_{n}").size, drone_half_size(vehicle))
        own = model.geom_bodyid == model.body(f"drone_{n}").id
        assert model.geom_size[own & discs][:, 0].max() == pytest.approx(0.62 * vehicle.arm)


# What cannot be


@pytest.mark.parametrize(
    "overrides, complaint",
    [
        (
            {"vehicle.preset": MIX[:3]},
            r"vehicle\.preset lists 3 values for env\.num_drones=4: give one value or one for",
        ),
        ({"vehicle.mass": [0.6] * 5}, r"vehicle\.mass lists 5 values for env\.num_drones=4"),
        ({"vehicle.inertia": [[2e-3] * 3] * 2}, r"vehicle\.inertia lists 2 values for env\.num_drones=4"),
        ({"vehicle.inertia": [1, 2, 3, 4]}, r"vehicle\.inertia must be a list of 3 numbers"),
        ({"vehicle.preset": [*MIX[:3], "irys"]}, r"drone 3: unknown vehicle\.preset 'irys'; did you mean 'iris'\?"),
        ({"vehicle.mass": [0.6, 3, 0.6, 0.6]}, r"drone 1: vehicle 'falcon' of vehicle\.mass=3 kg cannot lift itself"),
        ({"vehicle.preset": MIX, "payload.mass": 6}, r"2 × falcon, 1 × hummingbird, 1 × iris lift 92\.3 N, less than"),
        (
            {"vehicle.preset": MIX, "payload.mass": 4.2},
            r"drone \d would need \d+\.\d N of its \d+\.\d N to hover under",
        ),
        (
            {"vehicle.preset": ["crazyflie", *MIX[1:]]},
            r"drone 0 would need 0\.\d N of its 0\.6 N to hover under the heaviest payload",
        ),
        (
            {"vehicle.preset": MIX, "cable.angle": 5, "payload.size": [0.3, 0.2, 0.1]},
            r"neighbouring drones 0 and 3 would rest 0\.\d\d m apart, closer than 1\.1 × the .* limit of 0\.58 m",
        ),
    ],
)
def test_an_impossible_team_is_refused_by_name(overrides, complaint):
    message = refuse_system(4, **overrides)
    assert re.match(complaint, message), message


@pytest.mark.slow
def test_a_mixed_team_opens_every_task(task, cables):
    vec = make(task, num_envs=1, **{"vehicle.preset": MIX}, **cables)
    vec.reset(seed=0)
    vec.step(zeros(vec))
    assert floats(vec.task.rig.mass) == floats([PRESETS[name].mass for name in MIX])
    assert ml.load_config(task, {"env.num_drones": 4, "vehicle.preset": MIX}).system.num_drones == 4
