"""What drones observe and how late: noise, bias and delays, which reward, success and critic know nothing of."""

import numpy as np
import pytest
from conftest import bold_actions, make, mask, same, zeros

from multilift_marl.sensing.measurement import STANDARD

NOISE = {"randomization.observation_noise": "standard"}
BIAS = {"randomization.observation_bias": "standard"}
BOTH = {**NOISE, **BIAS, "randomization.action_delay": [0, 3], "randomization.observation_delay": [1, 4],
        "randomization.vehicle_mass": 0.1, "randomization.cable_length": 0.05, "randomization.wind": 2.0,
        "env.episode_seconds": 1.0}  # fmt: skip
KINDS = {"velocity": 1, "body_rates": 3, "payload_velocity": 1, "slot_error": 0, "payload_error": 0}


def columns(vec, name: str) -> list[int]:
    """Return where a component stands in an observation."""
    return [i for i, own in enumerate(vec.observation_names) if own.rpartition("_")[0] == name]


def errors_of(settings: dict, episodes: int = 1, steps: int = 30, num_envs: int = 40):
    """Return the imperfect batch, and observations less those of a perfect one that flies the same (T, E, N, D)."""
    blurred, clear = (make(num_envs=num_envs, num_drones=2, **own) for own in (settings, {}))
    gaps = []
    for _ in range(episodes):
        seen, true = blurred.reset()[0], clear.reset()[0]
        gaps.append(seen.astype(float) - true)
        for _ in range(steps):
            seen, true = blurred.step(zeros(blurred))[0], clear.step(zeros(clear))[0]
            gaps.append(seen.astype(float) - true)
    return blurred, np.array(gaps)


@pytest.mark.parametrize("factor", [0.5, 1.0])
def test_noise_has_the_standard_size_is_white_and_of_each_its_own(factor):
    vec, gap = errors_of({"randomization.observation_noise": factor})
    for name, kind in KINDS.items():
        part = gap[..., columns(vec, name)]
        assert part.std() == pytest.approx(factor * STANDARD[kind], rel=0.05), name
        assert abs(part.mean()) < 6 * factor * STANDARD[kind] / np.sqrt(part.size)
        assert abs((part[1:] * part[:-1]).mean() / part.var()) < 0.06  # from step to step
        assert abs((part[:, 1:] * part[:, :-1]).mean() / part.var()) < 0.06  # from environment to environment
    own = gap[..., columns(vec, "body_rates")]
    assert abs((own[:, :, 0] * own[:, :, 1]).mean() / own.var()) < 0.06  # from drone to drone
    lengths = np.linalg.norm(gap[..., columns(vec, "payload_error")], axis=-1)
    np.testing.assert_allclose(lengths[:, :, 0], lengths[:, :, 1], atol=1e-6)  # all are told the same of the payload
    turned = gap[..., columns(vec, "payload_rotation_error")]
    assert turned.std() == pytest.approx(factor * 0.01, rel=0.05)


def test_what_has_no_noise_is_known_as_it_is():
    vec = make(num_envs=2, num_drones=4, **NOISE)
    vec.reset(seed=0)
    vec.step(np.full((2, 4, vec.action_size), 0.3, np.float32))
    known, true = vec.task.view.estimated, vec.world.state
    for name in ("rotor_speed", "cable_tension", "cable_broken"):
        assert np.array_equal(getattr(known, name), getattr(true, name)), name
    assert (known.rotor_speed > 100).all() and (known.cable_tension > 0).all()


def test_what_was_measured_is_saved_with_the_environments():
    vec, other = make(num_envs=2, num_drones=2, **NOISE), make(num_envs=2, num_drones=2, **NOISE)
    for each, seed in ((vec, 0), (other, 5)):
        each.reset(seed=seed)
        each.step(np.full((2, 2, each.action_size), 0.3, np.float32))
    other.load_state_dict(vec.state_dict())
    for name, known, loaded in zip(
        vec.task.view.estimated._fields, vec.task.view.estimated, other.task.view.estimated, strict=True
    ):
        assert np.array_equal(known, loaded), name


def test_noise_is_consistent_over_the_parts_of_an_observation():
    vec, gap = errors_of(NOISE, steps=3)
    own = gap[..., columns(vec, "slot_error")]
    np.testing.assert_allclose(own, gap[..., columns(vec, "tracking_error")], atol=1e-5)
    assert (gap[..., columns(vec, "reference_velocity")] == 0).all()
    assert (gap[..., columns(vec, "previous_action")] == 0).all()


def test_noise_adds_up_in_the_integrals_that_drones_keep():
    vec, gap = errors_of(NOISE)
    summed = np.cumsum(gap[1:, ..., columns(vec, "payload_error")], axis=0) * 0.02
    turn = np.linalg.norm(gap[1:, ..., columns(vec, "payload_error_integral")], axis=-1)
    np.testing.assert_allclose(turn, np.linalg.norm(summed, axis=-1), atol=1e-5)


def test_bias_is_constant_in_an_episode_and_new_in_the_next():
    vec, gap = errors_of(BIAS, episodes=2)
    for name, kind in KINDS.items():
        first, second = np.split(gap[..., columns(vec, name)], 2)
        if "velocity" in name or name == "body_rates":  # other frames turn a little
            np.testing.assert_allclose(first, first[:1].repeat(len(first), 0), atol=1e-4)
        assert first[0].std() == pytest.approx(STANDARD[kind], rel=0.2), name
        assert abs((first[0] * second[0]).mean()) < 0.35 * first[0].var()
    told = vec.current()[1]["randomization"]["observation_bias"]
    assert told.shape == (40, 3, 4, 3)
    rates = gap[-1][..., columns(vec, "body_rates")]
    np.testing.assert_allclose(rates, told[:, :2, 3], atol=1e-4)
    np.testing.assert_allclose(told.std(axis=(0, 1, 3)), STANDARD, rtol=0.15)


def test_reward_errors_and_critic_are_true(task, cables):
    settings = {**NOISE, **BIAS, "randomization.observation_delay": 2}
    blurred, clear = make(task, **settings, **cables), make(task, **cables)
    assert not same(blurred.reset()[0], clear.reset()[0])
    for step in range(20):
        action = bold_actions(clear, step)
        seen, reward, *_ = blurred.step(action)
        true, expected, *_ = clear.step(action)
        assert not same(seen, true)
        assert same(reward, expected) and same(blurred.state(), clear.state())
        assert same(blurred.task.errors, clear.task.errors) and same(blurred.world.state, clear.world.state)


@pytest.mark.parametrize("delay", [1, 3])
def test_observations_come_exactly_so_many_steps_late(task, cables, delay):
    late, prompt = make(task, **{"randomization.observation_delay": delay}, **cables), make(task, **cables)
    for _ in range(2):
        seen, true = [late.reset()[0]], [prompt.reset()[0]]
        for step in range(8):
            action = bold_actions(late, step, hold=1)
            seen.append(late.step(action)[0])
            true.append(prompt.step(action)[0])
        own = columns(late, "previous_action")
        rest = [i for i in range(late.observation_size) if i not in own]
        for k in range(9):
            assert same(seen[k][..., rest], true[max(k - delay, 0)][..., rest])
            assert same(seen[k][..., own], true[k][..., own])


@pytest.mark.parametrize("delay", [1, 3])
@pytest.mark.parametrize("action", ["reference", "acceleration", "rotor"])
def test_actions_are_flown_exactly_so_many_steps_late_and_zero_before(delay, action):
    settings = {"control.action": action}
    late, prompt = make(**settings, **{"randomization.action_delay": delay}), make(**settings)
    late.reset()
    prompt.reset()
    plan = [0.2 * bold_actions(prompt, step, hold=1) for step in range(9)]
    for step in range(9):
        late.step(plan[step])
        prompt.step(plan[step - delay] if step >= delay else zeros(prompt))
        assert same(late.world.state, prompt.world.state)
    own = late.current()[0][..., columns(late, "previous_action")]
    assert same(own, plan[8].astype(np.float32))  # drones know what they have commanded


def test_delays_are_drawn_uniformly_for_each_episode():
    vec = make(num_envs=200, **{"randomization.action_delay": [1, 3], "randomization.observation_delay": [0, 1]})
    drawn = [vec.reset()[1]["randomization"] for _ in range(3)]
    actions = np.concatenate([draw["action_delay"] for draw in drawn])
    observations = np.concatenate([draw["observation_delay"] for draw in drawn])
    assert np.bincount(actions, minlength=4)[0] == 0 and (np.abs(np.bincount(actions)[1:] - 200) < 50).all()
    assert (np.abs(np.bincount(observations) - 300) < 60).all()


@pytest.mark.parametrize("model", ["massless", "chain"])
def test_results_do_not_depend_on_batch_threads_or_neighbours(model):
    batch = make(num_envs=5, num_drones=2, num_threads=2, seed=5, **BOTH, **{"cable.model": model})
    alone = make(num_envs=1, num_drones=2, first_env=3, seed=5, **BOTH, **{"cable.model": model})
    ended = np.ones(5, bool)
    for step in range(90):
        if ended.any():
            crowded = batch.reset(mask=ended)
            if ended[3]:
                single = alone.reset()
                assert same(crowded[0][3], single[0][0])
                assert same({k: v[3] for k, v in crowded[1]["randomization"].items()},
                            {k: v[0] for k, v in single[1]["randomization"].items()})  # fmt: skip
        first, second = batch.step(bold_actions(batch, step)), alone.step(bold_actions(alone, step, 3))
        assert same(first[0][3], second[0][0]) and same(first[1][3], second[1][0])
        ended = first[2] | first[3]
        assert ended[3] == (second[2] | second[3])[0]


@pytest.mark.parametrize("model", ["massless", "chain"])
def test_a_restored_batch_goes_on_bit_for_bit(model):
    first, second = (
        make(num_envs=4, num_drones=2, num_threads=threads, **BOTH, **{"cable.model": model}) for threads in (1, 2)
    )
    first.reset(seed=2)
    second.reset(seed=9)
    for step in range(7):
        first.step(bold_actions(first, step, hold=3))
    second.load_state_dict(first.state_dict())
    assert same(first.current()[1]["randomization"], second.current()[1]["randomization"])
    for step in range(7, 60):
        one, other = first.step(bold_actions(first, step, hold=3)), second.step(bold_actions(second, step, hold=3))
        assert same(one, other)
        ended = one[2] | one[3]
        if ended.any():
            assert same(first.reset(mask=ended), second.reset(mask=ended))


def test_a_point_has_no_attitude_to_mismeasure():
    settings = {"payload.shape": "point", "payload.mass": 0.7}
    blurred, clear = make(num_drones=2, **NOISE, **settings), make(num_drones=2, **settings)
    seen, true = blurred.reset()[0], clear.reset()[0]
    rotation, position = columns(blurred, "payload_rotation_error"), columns(blurred, "payload_error")
    assert same(seen[..., rotation], true[..., rotation]) and not same(seen[..., position], true[..., position])


def test_a_masked_reset_leaves_the_memory_of_others_alone():
    vec, calm = (make(num_envs=3, num_drones=2, **BOTH) for _ in range(2))
    vec.reset(seed=1)
    calm.reset(seed=1)
    for step in range(30):
        if step == 10:
            vec.reset(mask=mask(3, 1))
        one, other = vec.step(zeros(vec)), calm.step(zeros(calm))
        assert same(one[0][[0, 2]], other[0][[0, 2]])


def test_measured_attitudes_are_the_true_ones_turned_by_standard_noise():
    vec = make("hover", num_envs=100, **{"randomization.observation_noise": "standard"})
    vec.reset(seed=0)
    true, seen = vec.world.state, vec.task.view.estimated
    for name in ("drone_rotation", "payload_rotation"):
        turned = getattr(seen, name) @ np.swapaxes(getattr(true, name), -1, -2)
        np.testing.assert_allclose(
            turned @ np.swapaxes(turned, -1, -2), np.broadcast_to(np.eye(3), turned.shape), atol=1e-12
        )
        off = np.stack([turned[..., 2, 1], turned[..., 0, 2], turned[..., 1, 0]])
        assert 0.008 < off.std() < 0.012
