"""Why episodes were no success: the failures that ended some, and what the others missed the criterion by."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import ceil
from typing import Any

import numpy as np

from multilift_marl.envs.core import MultiliftVec
from multilift_marl.mdp.criteria import Criterion, says_criteria

EXCESS, BOUND = "excess:", "bound:"  # before a criterion's name, in what `run_episodes` returns
_UNITS = {  # suffix of a criterion's name: unit shown, factor
    "_rad_s": ("rad/s", 1), "_m_s": ("m/s", 1), "_deg": ("deg", 1), "_m": ("cm", 100), "_s": ("s", 1), "_n": ("N", 1),
}  # fmt: skip


def is_shortfall(name: str) -> bool:
    """Return whether an entry of what `run_episodes` returns is for `explain`, and no metric."""
    return name.startswith((EXCESS, BOUND))


class ShortfallMeter:
    """Measures how far episodes are beyond the bounds of their task's success, at the worst moment that counts.

    Args:
        vec: environments at the start of their episodes.
    """

    def __init__(self, vec: MultiliftVec):
        self._task, self._last = vec.task, vec.max_steps
        known, dt = says_criteria(type(vec.task)), vec.task.dt
        self._criteria: tuple[Criterion, ...] = vec.task.criteria() if known else ()
        windows = [window for window in vec.task.success_windows() if window[1] > window[0]] if known else []
        self._ends: dict[int, float] = {}  # step: for how long [s] the payload has to have been good
        self._counts = np.zeros(vec.max_steps + 1, bool)
        for begin, end in windows:
            last = min(round(end / dt), vec.max_steps)
            self._ends[last] = end - begin
            self._counts[max(last + 1 - ceil((end - begin) / dt - 1e-6), 1) : last + 1] = True
        self._worst = np.full((len(self._criteria), vec.num_envs), -np.inf)
        self._missing = np.full(vec.num_envs, -np.inf)  # of the time [s]

    def measure(self, step: int) -> None:
        """Measure after a step, the first of which is 1."""
        for worst, criterion in zip(self._worst, self._criteria, strict=True):
            if self._counts[step] if criterion.throughout else step == self._last:
                np.maximum(worst, criterion.excess(), out=worst)
        if step in self._ends:
            missing = self._ends[step] - self._task.good_time
            np.maximum(self._missing, np.where(missing > 1e-9, missing, 0.0), out=self._missing)

    def result(self, missed: np.ndarray) -> dict[str, np.ndarray]:
        """Return excess and bound of each criterion, (E,) each; only those of `missed` (E,) are meant, others are 0."""
        found = {each.name: (worst, each.bound) for each, worst in zip(self._criteria, self._worst, strict=True)}
        if self._ends:
            found["time_held_s"] = self._missing, max(self._ends.values())
        result = {}
        for name, (excess, bound) in found.items():
            result[EXCESS + name] = np.where(missed, np.maximum(excess, 0.0), 0.0)
            result[BOUND + name] = np.full(len(missed), bound)
        return result


def explain(episodes: Mapping[str, np.ndarray], causes: Sequence[str]) -> dict[str, Any]:
    """Return why episodes were no success, ready for JSON.

    Args:
        episodes: what `run_episodes` measured, (n,) each.
        causes: names of the causes of failures.

    Returns:
        `episodes`: how many were none. `failures`: how many ended by each cause. `missed`: of those without a failure
        {criterion: {"episodes", "bound", "median_excess"}}, an episode at each that it missed; bound and excess are
        None where a condition was not met. `unexplained`: how many of them missed none that is known.
    """
    success, cause = episodes["success_rate"], episodes["failure_cause"]
    counts = np.bincount(cause, minlength=len(causes))
    left, missed = ~success & (cause == 0), {}
    for key, excess in episodes.items():
        beyond = excess > 0
        if key.startswith(EXCESS) and beyond.any():
            name = key.removeprefix(EXCESS)
            bound = float(episodes[BOUND + name][0])
            is_number = bool(np.isfinite(bound))
            missed[name] = {
                "episodes": int(beyond.sum()),
                "bound": bound if is_number else None,
                "median_excess": float(np.median(excess[beyond])) if is_number else None,
            }
            left &= ~beyond
    return {
        "episodes": int((~success).sum()),
        "failures": {name: int(counts[i]) for i, name in enumerate(causes) if i > 0 and counts[i]},
        "missed": missed,
        "unexplained": int(left.sum()),
    }


def format_explanation(explanation: Mapping[str, Any], name: str, episodes: int) -> str:
    """Return why episodes of a policy were no success, as a few lines; "" where all were."""
    if not explanation["episodes"]:
        return ""
    lines = [f"{name}: {explanation['episodes']} of {episodes} episodes without success"]
    if failures := explanation["failures"]:
        lines.append("  failures: " + ", ".join(f"{cause.replace('_', ' ')} {n}" for cause, n in failures.items()))
    lines += [f"  missed: {_describe(each, values)}" for each, values in explanation["missed"].items()]
    if explanation["unexplained"]:
        lines.append(f"  not explained: {explanation['unexplained']}, by what the task's `succeeded` asks for")
    return "\n".join(lines)


def _describe(name: str, values: Mapping[str, Any]) -> str:
    suffix = next((suffix for suffix in _UNITS if name.endswith(suffix)), "")
    unit, factor = _UNITS.get(suffix, ("", 1))
    heading, count = name.removesuffix(suffix).replace("_", " "), values["episodes"]
    if values["bound"] is None:
        return f"{heading} in {count}"
    bound, excess = (f"{factor * values[key]:.3g} {unit}".strip() for key in ("bound", "median_excess"))
    return f"{heading} in {count}, bound {bound}, by {excess} (median)"
