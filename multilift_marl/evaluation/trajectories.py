"""Trajectories of evaluated episodes: states, actions, rotor thrusts, references and tensions, as .npz and as a table.

Episodes are written as they are flown, to files that are mapped into memory: it holds no more than a batch's step.
"""

from __future__ import annotations

import csv
import json
import shutil
import tempfile
import zipfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple

import numpy as np

from multilift_marl.config.config import Config
from multilift_marl.config.load import build_config
from multilift_marl.envs.core import MultiliftVec
from multilift_marl.errors import ConfigError

Arrays = dict[str, np.ndarray]


class Quantity(NamedTuple):
    """What is recorded after each step, and at the start unless an action has to have been taken first."""

    unit: str
    meaning: str
    read: Callable[[MultiliftVec], np.ndarray]
    """Live values of all environments, environment first."""
    from_start: bool = True


def _state(name: str) -> Callable[[MultiliftVec], np.ndarray]:
    return lambda vec: getattr(vec.world.state, name)


def _reference(name: str) -> Callable[[MultiliftVec], np.ndarray]:
    return lambda vec: getattr(vec.reference, name)


QUANTITIES: dict[str, Quantity] = {
    "payload_position": Quantity("m", "centre of mass as configured, world frame", _state("payload_position")),
    "payload_rotation": Quantity("-", "matrix, body to world", _state("payload_rotation")),
    "payload_velocity": Quantity("m/s", "world frame", _state("payload_velocity")),
    "payload_body_rates": Quantity("rad/s", "body frame", _state("payload_body_rates")),
    "drone_position": Quantity("m", "centre of mass, world frame", _state("drone_position")),
    "drone_rotation": Quantity("-", "matrix, body to world", _state("drone_rotation")),
    "drone_velocity": Quantity("m/s", "world frame", _state("drone_velocity")),
    "drone_body_rates": Quantity("rad/s", "body frame", _state("drone_body_rates")),
    "rotor_speed": Quantity("rad/s", "of each rotor, with its lag", _state("rotor_speed")),
    "rotor_thrust": Quantity("N", "commanded in the last control step", lambda vec: vec.world.thrust, False),
    "cable_tension": Quantity("N", "at the drone", _state("cable_tension")),
    "cable_broken": Quantity("-", "1: the cable is broken", _state("cable_broken")),
    "target_position": Quantity("m", "of the payload, world frame", lambda vec: vec.task.goal.position),
    "target_rotation": Quantity("-", "of the payload, matrix to world", lambda vec: vec.task.goal.rotation),
    "reference_position": Quantity("m", "of each drone, world frame", _reference("position")),
    "reference_yaw": Quantity("rad", "heading of each drone", _reference("yaw")),
    "action": Quantity("-", "in [-1, 1]; `about` has the names of its numbers", lambda vec: vec.task.action, False),
}
_NPZ = "trajectories.npz"
_GROUP = 20_000  # rows of a group of Parquet


class Recording:
    """Records the first episodes of environments into arrays.

    Args:
        arrays: (episodes, steps + 1, ...) by name, and "steps" (episodes,); written.
        first: row of the first environment.
    """

    def __init__(self, arrays: Mapping[str, np.ndarray], first: int = 0):
        self._arrays, self._first, self._step = arrays, first, 0
        self._running: np.ndarray | None = None

    def __call__(self, vec: MultiliftVec) -> None:
        """Record the start, and from then on each step that has just been made."""
        chosen = np.arange(vec.num_envs) if self._running is None else self._running
        for name, quantity in QUANTITIES.items():
            if self._step or quantity.from_start:
                self._arrays[name][self._first + chosen, self._step] = quantity.read(vec)[chosen]
            else:
                self._arrays[name][self._first + chosen, 0] = np.nan
        self._arrays["steps"][self._first + chosen] = self._step
        # Those that have just ended have their last row: what follows there is of other episodes.
        self._running = chosen[~vec.ended[chosen]] if self._step else chosen
        self._step += 1


def make_arrays(vec: MultiliftVec, episodes: int) -> Arrays:
    """Return empty arrays for a `Recording` of so many episodes of environments like these."""
    return {name: np.zeros(shape) for name, shape in _shapes(vec, episodes).items()} | {
        "steps": np.zeros(episodes, int)
    }


def _shapes(vec: MultiliftVec, episodes: int) -> dict[str, tuple[int, ...]]:
    return {name: (episodes, vec.max_steps + 1, *each.read(vec).shape[1:]) for name, each in QUANTITIES.items()}


class TrajectoryWriter:
    """Writes trajectories.npz and trajectories.csv (.parquet where pyarrow is installed); a context.

    Args:
        folder: for the files, which is there.
        config: the environment.
        episodes: how many there will be.
        seed: evaluation seed, for `about`.

    Attributes:
        files: that it writes.

    Raises:
        ConfigError: the files cannot be there, or the disk has no room for them.
    """

    def __init__(self, folder: Path, config: Config, episodes: int, seed: int):
        vec = MultiliftVec(build_config(config.model_dump(), {"env.num_envs": 1, "env.num_threads": 1}))
        self._shapes = _shapes(vec, episodes)
        self._dt, self._seed, self._actions = vec.task.dt, seed, vec.action_names
        self._table = folder / ("trajectories.csv" if find_spec("pyarrow") is None else "trajectories.parquet")
        self.files = (folder / _NPZ, self._table)
        for path in self.files:
            if path.is_dir():
                raise ConfigError(f"cannot write {path}, which is a folder; give another folder by out=<folder>")
        needed, free = 8 * sum(int(np.prod(shape)) for shape in self._shapes.values()), shutil.disk_usage(folder).free
        needed *= 5 if self._table.suffix == ".csv" else 3  # while they are written, and as text
        if needed > free:
            raise ConfigError(
                f"trajectories of {episodes} episodes take {needed / 1e9:.1f} GB, but {folder} has {free / 1e9:.1f}; "
                "ask for fewer episodes, or give another folder by out=<folder>"
            )
        # On the disk of the files themselves, so that whole ones are only renamed at the end.
        self._folder = Path(tempfile.mkdtemp(dir=folder, prefix=".trajectories-"))
        self._arrays: Arrays = {
            name: np.lib.format.open_memmap(self._folder / f"{name}.npy", "w+", np.float64, shape)
            for name, shape in self._shapes.items()
        }
        self._arrays["steps"] = np.zeros(episodes, int)

    def record(self, first: int) -> Recording:
        """Return what records the episodes from number `first` on."""
        return Recording(self._arrays, first)

    def put(self, first: int, arrays: Arrays) -> None:
        """Take the episodes from number `first` on, recorded elsewhere into `make_arrays`."""
        for name, array in arrays.items():
            self._arrays[name][first : first + len(array)] = array

    def finish(self) -> None:
        """Write the files.

        Raises:
            OSError: they cannot be written; there is none of them then.
        """
        for name in self._shapes:
            for rows, steps in zip(self._arrays[name], self._arrays["steps"], strict=True):
                # Past its end an episode has no numbers, where a new file has zeros.
                rows[steps + 1 :] = np.nan
        more = {"steps": self._arrays["steps"], "time": self._time(), "about": np.array(json.dumps(self._about()))}
        for name, array in more.items():
            np.save(self._folder / f"{name}.npy", array)
        whole = self._folder / _NPZ
        with zipfile.ZipFile(whole, "w", zipfile.ZIP_STORED, allowZip64=True) as archive:
            for name in (*more, *self._shapes):
                mapped = self._arrays.get(name)
                if isinstance(mapped, np.memmap):
                    # The file is read by its name below, and has to hold what was written to memory.
                    mapped.flush()
                entry = zipfile.ZipInfo(f"{name}.npy")  # without a date: the same flights are the same file
                with (
                    open(self._folder / entry.filename, "rb") as source,
                    archive.open(entry, "w", force_zip64=True) as sink,
                ):
                    shutil.copyfileobj(source, sink, 1 << 20)
        table = self._folder / self._table.name
        (_write_csv if table.suffix == ".csv" else _write_parquet)(table, self._columns(), self._rows())
        for path in self.files:
            (self._folder / path.name).replace(path)

    def _time(self) -> np.ndarray:
        return np.arange(self._shapes["action"][1]) * self._dt

    def _about(self) -> dict[str, Any]:
        """Return what the arrays mean, ready for JSON."""
        arrays = {name: {"unit": each.unit, "meaning": each.meaning} for name, each in QUANTITIES.items()}
        return {
            "arrays": arrays
            | {
                "time": {"unit": "s", "meaning": "since the start"},
                "steps": {"unit": "-", "meaning": "of each episode"},
            },
            "action_names": list(self._actions),
            "seed": self._seed,
        }

    def _columns(self) -> list[str]:
        """Return the table's columns: arrays with the place in them, drone_position_2_0 is x of drone 2."""
        names = ["episode", "step", "time"]
        for name, shape in self._shapes.items():
            names += ["_".join([name, *map(str, place)]) for place in np.ndindex(shape[2:])]
        return names

    def _rows(self) -> Iterator[np.ndarray]:
        """Yield the rows of each episode (steps + 1, columns)."""
        for i, steps in enumerate(self._arrays["steps"]):
            rows = slice(0, int(steps) + 1)
            count = np.arange(rows.stop)
            parts = [self._arrays[name][i, rows].reshape(rows.stop, -1) for name in self._shapes]
            yield np.column_stack([np.full(rows.stop, i), count, self._time()[rows], *parts])

    def __enter__(self) -> TrajectoryWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._arrays = {}  # unmapped, before they are deleted
        with suppress(OSError):
            shutil.rmtree(self._folder)


def _write_csv(path: Path, columns: list[str], rows: Iterator[np.ndarray]) -> None:
    """Write a table as text; numbers read back to the same bits, what is not known is empty."""
    with open(path, "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        for block in rows:
            for episode, step, *values in block.tolist():
                # Only NaN differs from itself.
                writer.writerow([int(episode), int(step), *("" if value != value else value for value in values)])


def _write_parquet(path: Path, columns: list[str], rows: Iterator[np.ndarray]) -> None:
    """Write a table as Parquet, in row groups of whole episodes."""
    import pyarrow
    import pyarrow.parquet

    kinds = {"episode": pyarrow.int64(), "step": pyarrow.int64()}
    schema = pyarrow.schema([(name, kinds.get(name, pyarrow.float64())) for name in columns])
    with pyarrow.parquet.ParquetWriter(path, schema, use_dictionary=False) as writer:
        for block in _join(rows):
            parts = [block[:, k].astype(np.int64 if name in kinds else float) for k, name in enumerate(columns)]
            writer.write_table(pyarrow.table(parts, schema=schema))


def _join(rows: Iterator[np.ndarray]) -> Iterator[np.ndarray]:
    """Yield blocks of `_GROUP` rows or a little more: what Parquet notes of each group stays in memory."""
    waiting: list[np.ndarray] = []
    for block in rows:
        waiting.append(block)
        if sum(len(each) for each in waiting) >= _GROUP:
            yield np.concatenate(waiting)
            waiting = []
    if waiting:
        yield np.concatenate(waiting)
