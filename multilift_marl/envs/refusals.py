"""What a step refuses, and the sentences that say why."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import NoReturn

import numpy as np

from multilift_marl.envs.step_kernels import ENDED, Outcome
from multilift_marl.errors import ConfigError
from multilift_marl.mdp.failures import FIRST_OWN


@contextmanager
def ending_all(ended: np.ndarray) -> Iterator[None]:
    """Mark all environments (E,) as ended where a step is interrupted, by Ctrl-C say: they are between two states."""
    try:
        yield
    except BaseException:
        ended[:] = True
        raise


def check_action(action: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Return actions (E, N, A) as an array; refuse another shape or type by a ValueError."""
    action = np.asarray(action)
    if action.shape != shape:
        raise ValueError(f"action has shape {action.shape}, expected {shape} (environments, drones, numbers)")
    if action.dtype.kind != "f":
        raise ValueError(f"action has dtype {action.dtype}, expected floating point numbers in [-1, 1]")
    return action


def refuse_action(why: int, action: np.ndarray, ended: np.ndarray, names: Sequence[str]) -> NoReturn:
    """Name what `take_actions` found: by a RuntimeError an episode that is over, by a ValueError what is not finite.

    Args:
        why: what it returned.
        action: (E, N, A).
        ended: (E,) environments that cannot go on.
        names: of the A numbers.
    """
    if why == ENDED:
        raise RuntimeError(
            f"environment {int(np.argmax(ended))} has ended or was never reset: call reset(mask=...) first"
        )
    e, n, k = np.argwhere(~np.isfinite(action))[0]
    raise ValueError(
        f"action of drone_{n} in environment {e} is not finite ({names[k]}={action[e, n, k]}); look for NaN in the "
        "policy"
    )


def refuse_step(env: int, outcome: Outcome, causes: int, task: str, reward_terms: Sequence[str]) -> NoReturn:
    """Name the cause of failure that is none, or the reward term that is not finite, by a ConfigError.

    Args:
        env: which environment's.
        outcome: of the step.
        causes: how many there are, with none.
        task, reward_terms: names.
    """
    cause, most = int(outcome.cause[env]), causes - 1
    if not 0 <= cause <= most:
        raise ConfigError(
            f"task {task} wrote {cause} as the cause of a failure in environment {env}; causes are 1 to "
            f"{most}: those of failures.CAUSES, then its own FAILURES from failures.FIRST_OWN = {FIRST_OWN} on"
        )
    bad = ~np.isfinite(outcome.terms[env])
    name = reward_terms[int(bad.argmax())] if bad.any() else "the sum"
    raise ConfigError(f"reward term {name} is not finite in environment {env}; mend what computes it")
