"""The batched core: seeds, masked resets, and episodes replayed bit for bit."""

from __future__ import annotations

import pytest
from conftest import INFO, bold_actions, make, mask, same, wide

from multilift_marl.envs.core import EVALUATION, MultiliftVec


def play(vec: MultiliftVec, steps: int, row: int, first_step: int = 0) -> tuple[list, int]:
    """Fly boldly, resetting what has ended, and return all that environment `row` showed and how often any ended."""
    shown, ends = [], 0
    for step in range(first_step, first_step + steps):
        observation, reward, terminated, truncated, info = vec.step(bold_actions(vec, step, vec.first_env))
        terms = {name: values[row] for name, values in info["reward_terms"].items()}
        told = [info[name][row] for name in sorted(INFO - {"reward_terms", "randomization"})]
        told += [values[row] for values in info["randomization"].values()]
        shown.append([observation[row], reward[row], terminated[row], truncated[row], vec.state()[row], terms, told])
        ended = terminated | truncated
        if ended.any():
            ends += int(ended.sum())
            observation, _ = vec.reset(mask=ended)
            if ended[row]:
                shown.append([observation[row], vec.state()[row]])
    return shown, ends


@pytest.mark.few_tasks
def test_same_seed_same_episodes(task, num_drones, cables):
    first, second = (make(task, num_drones=num_drones, seed=7, **cables) for _ in range(2))
    assert same(first.reset()[0], second.reset()[0])
    assert same(play(first, 120, row=2), play(second, 120, row=2))


def test_reset_with_a_seed_starts_over(task, num_drones, cables):
    vec = make(task, num_drones=num_drones, **cables)
    first = vec.reset(seed=3), play(vec, 60, row=1)
    again = vec.reset(seed=3), play(vec, 60, row=1)
    assert same(first, again)


def test_different_seeds_environments_episodes_and_purposes_differ(task, cables):
    vec = make(task, **cables)
    start, _ = vec.reset(seed=3)
    following, _ = vec.reset()
    other, _ = vec.reset(seed=4)
    evaluation, _ = MultiliftVec(vec.config, EVALUATION).reset(seed=3)
    for rows in (start, *zip(start, following, strict=True), *zip(start, other, strict=True)):
        assert not same(rows[0], rows[1])
    assert not any(same(a, b) for a, b in zip(start, evaluation, strict=True))


@pytest.mark.few_tasks
def test_an_environment_of_a_batch_is_replayed_alone(task, num_drones, cables):
    short = {"env.episode_seconds": 4.0}
    batch = make(task, num_envs=6, num_drones=num_drones, num_threads=2, seed=5, **short, **cables)
    alone = make(task, num_envs=1, num_drones=num_drones, first_env=5, seed=5, **short, **cables)
    assert same(batch.reset()[0][5], alone.reset()[0][0])
    crowded, ends = play(batch, 300, row=5)
    single, own_ends = play(alone, 300, row=0)
    assert ends > own_ends > 0
    assert same(crowded, single)


def test_an_episode_depends_on_seed_environment_and_number_alone(task, cables):
    busy, alone = make(task, num_envs=3, seed=5, **cables), make(task, num_envs=1, first_env=1, seed=5, **cables)
    for _ in range(3):
        wanted, _ = busy.reset()
    alone.reset()
    play(alone, 20, row=0)
    alone.reset(mask=mask(1, 0))
    reached, _ = alone.reset()
    assert (alone.episodes[0], busy.episodes[1]) == (2, 2)
    assert same(reached[0], wanted[1])


def test_a_seed_rewinds_the_masked_environments_only(task, cables):
    vec = make(task, num_envs=3, **cables)
    first, _ = vec.reset(seed=8)
    second, _ = vec.reset()
    mixed, _ = vec.reset(seed=8, mask=mask(3, 1))
    assert same(mixed[1], first[1])
    assert same(mixed[[0, 2]], second[[0, 2]])
    assert same(vec.reset()[0][1], second[1])
    assert vec.episodes.tolist() == [2, 1, 2]


def test_rows_outside_the_mask_are_unchanged(task, cables):
    vec = make(task, num_envs=4, num_threads=2, **cables)
    vec.reset(seed=1)
    for step in range(5):
        observation, *_ = vec.step(bold_actions(vec, step))
    state, saved = vec.state(), vec.state_dict()
    after, _ = vec.reset(mask=mask(4, 1, 2))
    assert same(after[[0, 3]], observation[[0, 3]])
    assert same(vec.state()[[0, 3]], state[[0, 3]])
    assert all(same(array[[0, 3]], saved[key][[0, 3]]) for key, array in vec.state_dict().items())
    assert not any(same(after[e], observation[e]) for e in (1, 2))


@pytest.mark.parametrize("threads", [(1, 2), (2, 1)], ids=str)
def test_a_saved_batch_continues_bit_for_bit(task, cables, threads):
    first, second = (make(task, num_envs=5, num_threads=count, seed=5, **wide(task), **cables) for count in threads)
    first.reset()
    play(first, 90, row=0)
    saved = first.state_dict()
    second.load_state_dict(saved)
    (expected, ends), (continued, _) = (play(vec, 200, row=3, first_step=90) for vec in (first, second))
    assert ends > 0
    assert same(continued, expected)
    assert same(first.state_dict(), second.state_dict())
