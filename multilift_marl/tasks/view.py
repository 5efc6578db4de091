"""What the kernels of a task read and write: one view of all arrays, and the payload's errors against its goal."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from types import CodeType, FunctionType, ModuleType
from typing import Any, NamedTuple

import numpy as np

from multilift_marl._jit import inlined
from multilift_marl.control.formation import Goal, Reference, Rig
from multilift_marl.math3d import clip, mat, matmul, matrow, norm, put, rotation_vector, row, sub, transpose, vec
from multilift_marl.sim.parameters import Parameters
from multilift_marl.sim.state import HiddenLoads, SystemState
from multilift_marl.tasks.failures import FailureMask, Limits
from multilift_marl.tasks.load_sensing import Load
from multilift_marl.tasks.starts import CableEquilibrium

INTEGRAL_LIMIT = 0.5  # of each component of the error integrals, as observed: a full action's worth of the scripts


class Errors(NamedTuple):
    """How far the payload is from its goal."""

    position: np.ndarray
    """(E, 3) payload minus target, world frame [m]."""
    rotation: np.ndarray
    """(E, 3) rotation vector from target to payload attitude, world frame [rad]."""
    distance: np.ndarray
    """(E,) [m]."""
    angle: np.ndarray
    """(E,) [rad]."""
    position_integral: np.ndarray
    """(E, 3) ∫ position dt, each component clipped; from the planned position where there is a plan [m s]."""
    rotation_integral: np.ndarray
    """(E, 3) ∫ rotation dt, in the same way [rad s]."""

    @classmethod
    def zeros(cls, num_envs: int, rows: int | None = None) -> Errors:
        """Return zero errors; with `rows` those that drones know, (E, rows, ...), see `Load`."""
        first = (num_envs,) if rows is None else (num_envs, rows)
        return cls(*(np.zeros(first + rest) for rest in ((3,), (3,), (), (), (3,), (3,))))

    def as_rows(self) -> Errors:
        """Return the same live arrays with one row for all drones."""
        return Errors(*(array[:, None] for array in self))


class View(NamedTuple):
    """All that a task's kernels read and write, of E environments of N drones; live arrays."""

    state: SystemState
    """True."""
    seen: SystemState
    """As each drone knows its own; `state` itself where nothing disturbs that."""
    load: Load
    """The payload as the drones know it; see `load_row`."""
    true_load: Load
    true_errors: Errors
    """`errors` with one row."""
    loads: HiddenLoads
    parameters: Parameters
    """True."""
    gust: np.ndarray
    """(E, 3) wind beside the mean, world frame [m/s]."""
    action_delay: np.ndarray
    """(E,) int64 [policy steps]."""
    goal: Goal
    planned: Goal
    """What the drones fly about: `goal` itself, unless a plan leads there."""
    has_plan: bool
    errors: Errors
    integral_limit: np.ndarray
    """(2,) of its integrals' components [m s], [rad s]."""
    seen_errors: Errors
    """From `load`, a row for each of its; `true_errors` where nothing disturbs that."""
    reference: Reference
    rig: Rig
    rig_numbers: np.ndarray
    """(N, 8) what tells the rig from others; see `tasks/rig_numbers.py`."""
    nominal: CableEquilibrium
    """The nominal team."""
    resting_tension: np.ndarray
    """(N,) of the nominal formation's cables [N]."""
    limits: Limits
    mask: FailureMask
    action: np.ndarray
    """(E, N, A) the last one."""
    previous: np.ndarray
    """(E, N, A) the one before."""
    time: np.ndarray
    """(E,) since the start of the episode [s]; advances where the task has a plan."""
    cause: np.ndarray
    """(E,) failure cause, an index into `failures.CAUSES`."""
    good_time: np.ndarray
    """(E,) for how long the payload has been within the success region [s]."""
    min_separation: np.ndarray
    """(E,) smallest distance between drones in the episode [m]."""
    terms: np.ndarray
    """(E, T) weighted reward terms."""
    dt: float
    """Policy step [s]."""
    control_dt: float
    """Control step [s]."""
    own: Any
    """Named tuple of the task's own arrays, environment first; saved with the state."""
    settings: Any
    """Named tuple of the task's constants."""


def reduce_view(view: View, *kernels: Callable[..., Any]) -> View:
    """Return the view with None in place of what no kernel names, neither itself nor by what it calls.

    Numba copies named tuples, array by array, wherever one is handed on: fewer of them compile and run faster.
    """
    names, seen = set[str](), set[Any]()
    for each in kernels:
        _collect_names(getattr(each, "py_func", each), names, seen)
    reduced: View = _keep(view, names)
    return reduced


def _collect_names(function: Any, names: set[str], seen: set[Any]) -> None:
    """Add the names in a function's code, and in that of the functions that it names."""
    if function in seen:
        return
    seen.add(function)
    own = set(_code_names(function.__code__))
    names |= own
    modules = [value for value in map(function.__globals__.get, own) if isinstance(value, ModuleType)]
    for name in own:
        for value in (function.__globals__.get(name), *(getattr(module, name, None) for module in modules)):
            called = getattr(value, "py_func", value)
            if isinstance(called, FunctionType):
                _collect_names(called, names, seen)


def _code_names(code: CodeType) -> Iterator[str]:
    """Return the names in a code object, and in those of comprehensions within it."""
    yield from code.co_names
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _code_names(constant)


def _keep(record: Any, names: set[str]) -> Any:
    """Return a named tuple with None in place of fields that are not among `names`."""
    values = []
    for name, value in record._asdict().items():
        kept = value if name in names else None
        values.append(_keep(kept, names) if hasattr(kept, "_fields") else kept)
    return type(record)(*values)


@inlined
def load_row(n, v):
    """Return the row of `load` and `seen_errors` that is drone n's."""
    return min(n, v.load.position.shape[1] - 1)


@inlined
def update_errors(e, k, load, errors, v, dt):
    """Update row k of the errors of environment e and integrate them over `dt` [s].

    Where the payload follows a plan, its distance from the planned pose is integrated: the distance from a goal still
    far away would only wind the integrals up.

    Args:
        e: the environment.
        k: row of load and errors.
        load: Load, true or as drones know it.
        errors: written.
        v: View.
        dt: since the last update [s].
    """
    goal, planned = v.goal, v.planned
    position, attitude = vec(load.position, e, k), mat(load.rotation, e, k)
    put(errors.position[e, k], sub(position, row(goal.position, e)))
    turned = matmul(attitude, transpose(matrow(goal.rotation, e)))
    put(errors.rotation[e, k], rotation_vector(turned))
    errors.distance[e, k] = norm(vec(errors.position, e, k))
    errors.angle[e, k] = norm(vec(errors.rotation, e, k))
    offset, rotation = vec(errors.position, e, k), vec(errors.rotation, e, k)
    if v.has_plan:
        offset = sub(position, row(planned.position, e))
        rotation = rotation_vector(matmul(attitude, transpose(matrow(planned.rotation, e))))
    for j in range(3):
        moved = errors.position_integral[e, k, j] + dt * offset[j]
        errors.position_integral[e, k, j] = clip(moved, -v.integral_limit[0], v.integral_limit[0])
        moved = errors.rotation_integral[e, k, j] + dt * rotation[j]
        errors.rotation_integral[e, k, j] = clip(moved, -v.integral_limit[1], v.integral_limit[1])
