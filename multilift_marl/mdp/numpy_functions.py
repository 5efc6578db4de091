"""Parts of a task that are plain NumPy functions of whole arrays, beside kernels: how they are called and checked.

Such a function is any callable that no decorator has made a kernel. At the policy rate, on the thread that steps, it
gets a read-only `View` of all environments, at the start of an episode of that environment alone, and returns an array,
environment first. Kernels stay what they are without them, so that nothing new is compiled for their sake.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from operator import attrgetter
from typing import Any, ClassVar, NamedTuple, Protocol

import numpy as np

from multilift_marl.control.formation import Goal, place_formation
from multilift_marl.errors import ConfigError
from multilift_marl.kernels.jit import FORMER_FIELDS, is_plain, prebind
from multilift_marl.math3d import turn
from multilift_marl.mdp.env_data import Call, View, reduce_view
from multilift_marl.mdp.failures import FIRST_OWN
from multilift_marl.mdp.observations import Component
from multilift_marl.mdp.rewards import Term
from multilift_marl.mdp.stage_kernels import Ahead, approach
from multilift_marl.sim.obstacles import Obstacles
from multilift_marl.sim.world import World

GOAL_FIELDS = {"position": (3,), "rotation": (3, 3), "velocity": (3,), "acceleration": (3,)}
"""Fields of a goal that a function may return, the environment first; velocity and acceleration are 0 without it."""
_SHARED = {
    View: ("rig", "rig_numbers", "resting_tension", "limits", "integral_limit", "settings"),
    Obstacles: ("vertices",),
}
"""Fields of named tuples that belong to no environment."""
_ROUNDING = 1e-9  # relative, of what is computed with more or fewer environments
_turn = getattr(turn, "py_func", turn)  # of arrays


class ArrayView:
    """What a NumPy function gets: the fields of `View`, read-only arrays of environments lo to hi, made when asked for.

    What belongs to no environment (`rig`, `resting_tension`, `limits`, `settings`, ...) is whole.

    Args:
        record: View, or a named tuple in it.
        rows: lo to hi.
    """

    def __init__(self, record: Any, rows: Any):
        # Past `__setattr__`, which refuses everything.
        vars(self).update(_record=record, _rows=rows)

    def __getattr__(self, name: str) -> Any:
        # Copies ask for names before there is a `_record`: to search for that would lead here again, for ever.
        if name.startswith("_"):
            raise AttributeError(name)
        if isinstance(self._record, View) and name in FORMER_FIELDS:
            return attrgetter(FORMER_FIELDS[name])(self)
        shared = name in _SHARED.get(type(self._record), ())
        value = _freeze(getattr(self._record, name), ... if shared else self._rows)
        # Kept as an attribute: the next look-up does not come here.
        vars(self)[name] = value
        return value

    def __setattr__(self, name: str, value: Any) -> None:
        raise AttributeError(f"the view of a NumPy function is read-only, and so is {name}")

    def __dir__(self) -> list[str]:
        return list(self._record._fields)

    def __repr__(self) -> str:
        return f"{type(self._record).__name__} of {', '.join(self._record._fields)}"


def _freeze(value: Any, rows: Any) -> Any:
    """Return rows of an array, or of those of a tuple, read-only."""
    if isinstance(value, np.ndarray):
        # A view of the array: that it is read-only leaves the array itself as it is.
        value = value[rows]
        value.flags.writeable = False
    elif hasattr(value, "_fields"):
        return ArrayView(value, rows)
    elif isinstance(value, tuple):
        return tuple(_freeze(each, rows) for each in value)
    return value


class _Function(NamedTuple):
    """A function, and what it has to return."""

    what: str
    """Its place in the task, such as "reward term 'near'"."""
    call: Callable[..., Any]
    record: View
    whole: ArrayView
    """Of `record`, of all environments."""
    shapes: Mapping[str, tuple[int, ...]] = {"": ()}
    """Of what it returns, after the environment: of one array under "", of a goal by field."""
    margins: tuple[float, ...] = ()
    is_truth: bool = False
    """Whether it returns truth values."""


class _Part(NamedTuple):
    """A component whose value a function returns, and the position of its first number."""

    at: int
    component: Component
    function: _Function


class Parts(Protocol):
    """What functions are looked for in: a task, see `tasks.base.Task`."""

    name: ClassVar[str]
    REWARD: ClassVar[dict[str, Term]]
    KERNELS: ClassVar[Any]
    world: World
    view: View
    observation: np.ndarray
    critic: np.ndarray
    weights: np.ndarray
    margins: np.ndarray

    def own_failures(self) -> dict[str, Any]:
        """Return what finds each failure of its own, by name."""


class NumpyFunctions:
    """The NumPy functions of a task; each method runs some of them for environments lo to hi, or does nothing.

    Args:
        task: whose they are; its arrays are written.
        true: View with the truth in place of what drones know, for the global state.
        observed: components of an observation.
        factors: that they are multiplied by (D,).
        of_state: components of the global state.

    Attributes:
        plans, judges, observes: whether there are functions that place goals; find failures or pay; observe.
    """

    def __init__(
        self, task: Parts, true: View, observed: Iterable[Component], factors: np.ndarray, of_state: Iterable[Component]
    ):
        self._task, self._view, self._diverged = task.name, task.view, task.world.diverged
        self._observation, self._critic = task.observation, task.critic
        self._factors, self._weights = factors, task.weights
        self._compared = set[str]()
        every = slice(0, task.world.num_envs)
        known, all_true = (task.view, ArrayView(task.view, every)), (true, ArrayView(true, every))
        plan = task.KERNELS.plan
        self._goal = _Function("KERNELS.plan", plan, *known, GOAL_FIELDS) if plan and is_plain(plan) else None
        self._ahead = Ahead(*(np.zeros((task.world.num_envs, *shape)) for shape in (*GOAL_FIELDS.values(), ())))
        self._failures = {
            number: _Function(f"failure '{name}'", call, *known, is_truth=True)
            for number, (name, call) in enumerate(task.own_failures().items(), FIRST_OWN)
            if is_plain(call)
        }
        self._terms = {
            i: _Function(f"reward term '{name}'", term.value, *known, margins=tuple(margins[: len(term.margins)]))
            for i, ((name, term), margins) in enumerate(zip(task.REWARD.items(), task.margins.tolist(), strict=True))
            if is_plain(term.value)
        }
        self._observed = list(_find_parts(observed, (task.world.num_drones,), known))
        self._of_state = list(_find_parts(of_state, (), all_true))
        self.plans, self.judges = self._goal is not None, bool(self._failures or self._terms)
        self.observes = bool(self._observed or self._of_state)

    def start_goals(self, lo: int, hi: int) -> None:
        """Put the goals of episodes that start where they are now."""
        if self._goal is not None:
            self._view.time[lo:hi] = 0.0
            self._place(self._view.goal, lo, hi)
            for e in range(lo, hi):
                place_formation(e, self._view.goal, self._view.rig)

    def plan_goals(self, lo: int, hi: int) -> None:
        """Find out where goals will be after a policy step; `approach` leads there."""
        time = self._view.time[lo:hi]
        now = time.copy()
        # The function sees the end of the step; the clock itself goes on in `approach`, step by step.
        time += self._view.dt
        self._ahead.time[lo:hi] = time
        try:
            self._place(self._ahead, lo, hi)
        finally:
            time[:] = now

    def bind_approach(self) -> Call:
        """Return the call of (lo, hi) that is the plan of a control step."""
        return prebind(approach, reduce_view(self._view, approach), self._ahead)

    def _place(self, goal: Goal | Ahead, lo: int, hi: int) -> None:
        """Write what the function returns into `goal`; it goes on in its attitude where none is returned."""
        assert self._goal is not None
        placed = self._evaluate(self._goal, lo, hi)
        goal.rotation[lo:hi] = placed.get("rotation", self._view.goal.rotation[lo:hi])
        goal.position[lo:hi] = placed["position"]
        goal.velocity[lo:hi] = placed.get("velocity", 0.0)
        goal.acceleration[lo:hi] = placed.get("acceleration", 0.0)

    def find_failures(self, lo: int, hi: int) -> None:
        """Write the causes of failures where no other was found."""
        cause = self._view.cause[lo:hi]
        for number, function in self._failures.items():
            found = self._evaluate(function, lo, hi)[""]
            cause[found & (cause == 0)] = number

    def judge(self, lo: int, hi: int) -> None:
        """Find failures and write reward terms."""
        self.find_failures(lo, hi)
        for i, function in self._terms.items():
            self._view.terms[lo:hi, i] = self._weights[i] * self._evaluate(function, lo, hi)[""]

    def observe(self, lo: int, hi: int) -> None:
        """Write components of observations and of the global state."""
        goal = self._view.goal
        for at, part, function in self._observed:
            value, numbers = self._evaluate(function, lo, hi)[""], slice(at, at + part.size)
            frame = goal.slot_frame[lo:hi]
            # From the world into the slot frame: a turn by minus its azimuth, of the same cosine and minus the sine.
            self._observation[lo:hi, :, numbers] = _turned(part, value, frame[..., 0], -frame[..., 1])
            self._observation[lo:hi, :, numbers] *= self._factors[numbers]
        for at, part, function in self._of_state:
            value, yaw = self._evaluate(function, lo, hi)[""], goal.yaw[lo:hi]
            self._critic[lo:hi, at : at + part.size] = _turned(part, value, np.cos(yaw), -np.sin(yaw))

    def _evaluate(self, function: _Function, lo: int, hi: int) -> dict[str, np.ndarray]:
        """Return what a function returns for environments lo to hi, by field; at its first call for all, compared."""
        count = len(self._diverged)
        if hi - lo < count:
            return self._call(function, ArrayView(function.record, slice(lo, hi)), lo, hi)
        values = self._call(function, function.whole, lo, hi)
        if count > 1 and function.what not in self._compared:
            self._compared.add(function.what)
            # The last one alone: as that is fewer than all, no further comparison follows.
            for name, alone in self._evaluate(function, hi - 1, hi).items():
                self._compare(function, values[name][-1], alone[0])
        return values

    def _call(self, function: _Function, view: ArrayView, lo: int, hi: int) -> dict[str, np.ndarray]:
        """Call a function and check what it returns."""
        found = function.call(view, *function.margins)
        if function.shapes is not GOAL_FIELDS:
            found = {"": found}
        elif not isinstance(found, dict) or not {"position"} <= found.keys() <= GOAL_FIELDS.keys():
            got = list(found) if isinstance(found, dict) else type(found).__name__
            raise self._error(
                function, f"returned {got}, expected a dict of {', '.join(GOAL_FIELDS)}, at least the first"
            )
        kinds, of = ("b", "bool") if function.is_truth else ("biuf", "numbers")
        values = {name: np.asarray(value) for name, value in found.items()}
        for name, value in values.items():
            wanted, field = (hi - lo, *function.shapes[name]), f"{name} of " if name else ""
            if value.shape != wanted or value.dtype.kind not in kinds:
                got = f"{field}shape {value.shape} of {value.dtype}"
                raise self._error(function, f"returned {got}, expected {wanted} of {of}, environment first")
            finite = np.isfinite(value)
            if finite.all():
                continue
            # A simulation that has diverged may hold anything; its step has no reward.
            bad = ~finite.reshape(hi - lo, -1).all(axis=1) & ~self._diverged[lo:hi]
            if bad.any():
                raise self._error(function, f"returned what is not finite in environment {lo + int(bad.argmax())}")
        return values

    def _compare(self, function: _Function, among: np.ndarray, alone: np.ndarray) -> None:
        """Check that an environment has the same value alone: episodes must not depend on how many there are."""
        if np.array_equal(among, alone, equal_nan=True):
            return
        if np.allclose(among, alone, _ROUNDING, 0.0, equal_nan=True):
            text = "rounds differently for one environment and for all; without `@`, episodes replay bit for bit"
            return warnings.warn(str(self._error(function, text)), stacklevel=2)
        number, got, other = len(self._diverged) - 1, among.tolist(), alone.tolist()
        raise self._error(
            function,
            f"returned {got} for environment {number} among all, but {other} for it alone; compute each row from that "
            "row, without random numbers",
        )

    def _error(self, function: _Function, text: str) -> ConfigError:
        name = getattr(function.call, "__name__", type(function.call).__name__)
        return ConfigError(f"task {self._task}: {function.what}, function {name}, {text}")


def _find_parts(parts: Iterable[Component], drones: tuple[int, ...], views: tuple[View, ArrayView]) -> Iterator[_Part]:
    """Yield the components that are NumPy functions, of so many `drones`, or () for what belongs to none."""
    at = 0
    for part in parts:
        if is_plain(part.value):
            shape = (*drones, 3 if part.is_turned else part.size)
            yield _Part(at, part, _Function(f"component '{part.name}'", part.value, *views, {"": shape}))
        at += part.size


def _turned(part: Component, value: np.ndarray, c: np.ndarray, s: np.ndarray) -> np.ndarray:
    """Return the numbers of a component (..., size), turned about z where it is a vector (..., 3) to be turned."""
    if not part.is_turned:
        return value
    return np.stack(_turn(c, s, (value[..., 0], value[..., 1], value[..., 2])), axis=-1)[..., : part.size]
