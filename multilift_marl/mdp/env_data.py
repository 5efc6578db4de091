"""What the kernels of a task read and write: one view of all arrays, and the payload's errors against its goal."""

from __future__ import annotations

from collections.abc import Callable
from types import FunctionType
from typing import Any, NamedTuple

import numpy as np

from multilift_marl.control.formation import Goal, Reference
from multilift_marl.kernels.cache import code_names, used_values
from multilift_marl.kernels.jit import inlined, prebind
from multilift_marl.math3d import clip, mat, matmul, matrow, norm, put, rotation_vector, row, sub, transpose, vec
from multilift_marl.mdp.failures import FailureMask, Limits
from multilift_marl.rig.constants import RigArrays
from multilift_marl.sim.cables.chain_arrays import Nodes
from multilift_marl.sim.obstacles import Obstacles
from multilift_marl.sim.parameters import Parameters
from multilift_marl.sim.state import HiddenLoads, SystemState

Call = Callable[[int, int], None]  # of environments lo to hi
INTEGRAL_LIMIT = 0.5  # of each component of the error integrals, as observed: a full action's worth of the baselines


class Load(NamedTuple):
    """The payload as drones know it: L = 1 for all, or L = N, each drone its own."""

    position: np.ndarray
    """(E, L, 3) centre of mass as configured [m]."""
    rotation: np.ndarray
    """(E, L, 3, 3) body to world."""
    velocity: np.ndarray
    """(E, L, 3) [m/s]."""
    body_rates: np.ndarray
    """(E, L, 3) body frame [rad/s]."""
    tension: np.ndarray
    """(E, N) of each drone's cable [N]."""


def true_load(state: SystemState) -> Load:
    """Return the true payload, the same for all drones; live."""
    return Load(
        state.payload_position[:, None], state.payload_rotation[:, None], state.payload_velocity[:, None],
        state.payload_body_rates[:, None], state.cable_tension,
    )  # fmt: skip


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
    estimated: SystemState
    """As each drone knows its own; `state` itself where nothing disturbs that."""
    payload_estimate: Load
    """The payload as the drones know it; see `load_row`."""
    payload: Load
    """True."""
    true_errors: Errors
    """`errors` with one row."""
    disturbances: HiddenLoads
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
    estimated_errors: Errors
    """From `payload_estimate`, a row for each of its; `true_errors` where nothing disturbs that."""
    reference: Reference
    rig: RigArrays
    """The nominal team."""
    rig_numbers: np.ndarray
    """(N, 8) what tells the rig from others; see `mdp/rig_features.py`."""
    resting_tension: np.ndarray
    """(N,) of the nominal formation's cables [N]."""
    limits: Limits
    mask: FailureMask
    action: np.ndarray
    """(E, N, A) the last one."""
    previous: np.ndarray
    """(E, N, A) the one before."""
    time: np.ndarray
    """(E,) since the start of the episode [s]; advances before the plan, without one before `Kernels.check`."""
    cause: np.ndarray
    """(E,) failure cause: an index into `failures.CAUSES`, from `failures.FIRST_OWN` on into the task's `FAILURES`."""
    good_time: np.ndarray
    """(E,) for how long the payload has been within the success region [s]."""
    min_separation: np.ndarray
    """(E,) smallest distance between drones in the episode [m]."""
    obstacles: Obstacles
    obstacle_readings: np.ndarray | None
    """(E, N, P) what drones observe of obstacles, see `sensing/obstacle_sensing.py` [m]; None if nothing."""
    nodes: Nodes | None
    """Of cables that are chains."""
    clearance: np.ndarray
    """(E,) least distance of drones, cables and payload from obstacles, at most `failures.SIGHT` [m]."""
    min_clearance: np.ndarray
    """(E,) the same in the episode so far [m]."""
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


def bind_kernel(kernel: Callable[..., Any], view: View, *arguments: Any) -> Call:
    """Return a call of (lo, hi) of a kernel of (lo, hi, View, *arguments), which gets what it names of the view."""
    return prebind(kernel, reduce_view(view, kernel), *arguments)


def in_turn(*calls: Call) -> Call:
    """Return a call of (lo, hi) that makes all, one after the other."""

    def call(lo: int, hi: int) -> None:
        for each in calls:
            each(lo, hi)

    return call


def _collect_names(function: Any, names: set[str], seen: set[Any]) -> None:
    """Add the names in a function's code, and in that of the functions that it uses, whoever handed them to it."""
    if function in seen:
        return
    seen.add(function)
    # Too many names do no harm: a field is kept that no kernel reads. Too few would be an error when Numba compiles.
    names |= set(code_names(function.__code__))
    for _, value in used_values(function):
        called = getattr(value, "py_func", value)
        if isinstance(called, FunctionType):
            _collect_names(called, names, seen)


def _keep(record: Any, names: set[str]) -> Any:
    """Return a named tuple with None in place of fields that are not among `names`."""
    values = []
    for name, value in record._asdict().items():
        kept = value if name in names else None
        values.append(_keep(kept, names) if hasattr(kept, "_fields") else kept)
    return type(record)(*values)


@inlined
def load_row(n, v):
    """Return the row of `payload_estimate` and `estimated_errors` that is drone n's."""
    # Row 0 for all, or row n of N.
    return min(n, v.payload_estimate.position.shape[1] - 1)


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
    # R R_dᵀ: the turn in the world frame that leads from the target to the payload. (R_dᵀ R would be in the target's
    # frame.)
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
        # Anti-windup: a component that is at its limit stays there until the error changes its sign.
        errors.position_integral[e, k, j] = clip(moved, -v.integral_limit[0], v.integral_limit[0])
        moved = errors.rotation_integral[e, k, j] + dt * rotation[j]
        errors.rotation_integral[e, k, j] = clip(moved, -v.integral_limit[1], v.integral_limit[1])
