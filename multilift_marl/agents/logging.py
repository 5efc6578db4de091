"""The record of a run: TensorBoard events, metrics.csv, versions.json."""

from __future__ import annotations

import csv
import io
import json
import platform
import subprocess
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import imageio.v3 as iio

from multilift_marl._files import write_whole
from multilift_marl._platform import cpu_name

if TYPE_CHECKING:
    from torch.utils.tensorboard import SummaryWriter

_PACKAGES = ("multilift_marl", "numpy", "mujoco", "numba", "torch", "torchrl", "tensordict", "gymnasium", "pettingzoo")
_GROUPS = {  # of TensorBoard's tags; names that have none and are not here belong to the update
    "episodes": ("return", "success", "failure", "diverged"),
    "speed": ("fps", "share_sampling", "share_learning"),
}


class RunLog:
    """Writes each iteration's numbers to TensorBoard, in groups, and to metrics.csv.

    Args:
        folder: the run's folder.
        iteration, frames: where the run goes on; what a stopped run has logged after that is dropped.
    """

    def __init__(self, folder: Path, iteration: int = 0, frames: int = 0):
        self._path = folder / "metrics.csv"
        self._rows: list[dict[str, Any]] = [row for row in read_metrics(folder) if int(row["iteration"]) <= iteration]
        self._columns = list(self._rows[0]) if self._rows else []
        self._behind = False  # whether rows are missing in the file
        if self._rows:
            self._rewrite()
        self._writer: SummaryWriter | None = _open_writer(folder, frames + 1 if iteration else None)

    def write(self, row: dict[str, float], values: dict[str, float]) -> None:
        """Write one iteration: `row` holds iteration and frames, `values` the numbers; TensorBoard's step is frames."""
        line = {**row, **values}
        new = [name for name in line if name not in self._columns]
        self._rows.append(line)
        self._columns += new
        if new or self._behind:  # columns that come only with an evaluation; rows that could not be written
            self._rewrite()
        else:
            self._behind = True
            with open(self._path, "a", newline="", encoding="utf-8") as file:
                csv.DictWriter(file, self._columns, restval="").writerow(line)
            self._behind = False
        if self._writer is None:
            self._writer = _open_writer(self._path.parent)
        for name, value in values.items():
            try:
                self._writer.add_scalar(_tag(name), value, row["frames"])
            except OSError:  # TensorBoard's writer never recovers: the next row begins a file of its own
                self._writer = None
                raise

    def write_text(self, tag: str, text: str, frames: int) -> None:
        """Show a text, as it is, in TensorBoard."""
        if self._writer is not None:
            self._writer.add_text(tag, "\n".join("    " + line for line in text.splitlines()), frames)

    def write_picture(self, tag: str, path: Path, frames: int) -> None:
        """Show a picture file in TensorBoard."""
        if self._writer is not None:
            self._writer.add_image(tag, iio.imread(path), frames, dataformats="HWC")

    def close(self) -> None:
        """Flush and close the event file."""
        with suppress(OSError):
            if self._writer is not None:
                self._writer.close()

    def _rewrite(self) -> None:
        self._behind = True
        text = io.StringIO(newline="")
        writer = csv.DictWriter(text, self._columns, restval="")
        writer.writeheader()
        writer.writerows(self._rows)
        write_whole(self._path, text.getvalue().encode(), flush=False)
        self._behind = False


def _open_writer(folder: Path, purge_step: int | None = None) -> SummaryWriter:
    """Return TensorBoard's writer, whose import takes a while."""
    from torch.utils.tensorboard import SummaryWriter

    return SummaryWriter(str(folder), purge_step=purge_step)


def _tag(name: str) -> str:
    """Return TensorBoard's tag of a number: its name, behind that of a group."""
    if "/" in name:
        return name
    return next((f"{group}/{name}" for group, names in _GROUPS.items() if name in names), f"update/{name}")


def read_metrics(folder: Path) -> list[dict[str, str]]:
    """Return the rows of a run's metrics.csv that are whole, empty if there are none yet."""
    path = folder / "metrics.csv"
    if not path.is_file():
        return []
    with open(path, newline="", encoding="utf-8", errors="replace") as file:
        return [row for row in csv.DictReader(file) if (row.get("iteration") or "").isdecimal()]


def write_versions(folder: Path) -> None:
    """Write versions.json: git commit, packages, Python and CPU."""
    (folder / "versions.json").write_text(
        json.dumps(
            {
                "git_commit": _git_commit(),
                "python": platform.python_version(),
                "platform": platform.platform(),
                "cpu": cpu_name(),
                "packages": package_versions(),
            },
            indent=2,
        )
        + "\n",
        encoding="utf-8",
    )


def package_versions(*more: str) -> dict[str, str | None]:
    """Return the version of each package that training depends on, and of `more`; None for one not installed."""
    return {name: _version(name) for name in (*_PACKAGES, *more)}


def _version(name: str) -> str | None:
    try:
        return version(name)
    except PackageNotFoundError:
        return None


def _git_commit() -> str | None:
    """Return the commit of the checkout that holds this package, marked "-dirty" if it has changes."""
    here = Path(__file__).parent
    command = ["git", "-C", str(here), "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"]
    try:
        tracked = subprocess.run(["git", "-C", str(here), "ls-files", "--error-unmatch", __file__], capture_output=True)
        done = subprocess.run(command, capture_output=True, text=True)
    except OSError:  # no git on this machine
        return None
    return done.stdout.strip() if done.returncode == 0 and tracked.returncode == 0 else None
