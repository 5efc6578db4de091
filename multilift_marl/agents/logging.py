"""The record of a run: metrics.csv, versions.json, and what its logger shows."""

from __future__ import annotations

import csv
import io
import json
import platform
import subprocess
import threading
from collections.abc import Callable
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tqdm import tqdm

from multilift_marl._files import write_whole
from multilift_marl._platform import cpu_name
from multilift_marl.evaluation.metrics import name_error

if TYPE_CHECKING:
    from multilift_marl.agents.loggers import Logger

_PACKAGES = ("multilift_marl", "numpy", "mujoco", "numba", "torch", "torchrl", "tensordict", "gymnasium", "pettingzoo")
_GROUPS = {  # of the logger's tags; names that have none and are not here belong to the update
    "episodes": ("return", "success", "failure", "diverged"),
    "curriculum": ("stage",),
    "speed": ("fps", "share_sampling", "share_learning"),
}


_THREAD = "_AsyncWriterThread"  # of TensorBoard, which writes its files


class RunLog:
    """Writes each iteration's numbers to metrics.csv, and to a logger in groups.

    Args:
        folder: the run's folder.
        iteration, frames: where the run goes on; what a stopped run has logged after that is dropped.
        logger: `train.logger`.

    Raises:
        ConfigError: see `make_logger`.
    """

    def __init__(self, folder: Path, iteration: int = 0, frames: int = 0, logger: str = "tensorboard"):
        self._path = folder / "metrics.csv"
        self._rows: list[dict[str, Any]] = [row for row in read_metrics(folder) if int(row["iteration"]) <= iteration]
        self._columns = list(self._rows[0]) if self._rows else []
        self._behind = False  # whether rows are missing in the file
        if self._rows:
            self._rewrite()
        self._hook = threading.excepthook
        threading.excepthook = self._swallow
        self._purge = frames + 1 if iteration else None
        self._name = logger
        self._logger: Logger | None = None
        with suppress(OSError):  # a disk that is full now may have room when there is something to write
            self._open()

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
        if self._logger is None:
            self._open()
        assert self._logger is not None
        try:
            self._logger.log_metrics({_tag(name): value for name, value in values.items()}, int(row["frames"]))
        except OSError:  # TensorBoard's writer never recovers: the next row begins a file of its own
            self._logger = None
            raise

    def write_hyperparameters(self, values: dict[str, Any]) -> None:
        """Log what the run is compared by."""
        if self._logger is not None:
            self._logger.log_hparams(values)

    def write_text(self, tag: str, text: str, frames: int) -> None:
        """Log a text, as it is."""
        if self._logger is not None:
            self._logger.log_text(tag, text, frames)

    def write_picture(self, tag: str, path: Path, frames: int) -> None:
        """Log a picture file."""
        if self._logger is not None:
            self._logger.log_picture(tag, path, frames)

    def close(self) -> None:
        """Write all and end."""
        with suppress(OSError):
            if self._logger is not None:
                self._logger.close()
        threading.excepthook = self._hook

    def _swallow(self, error: threading.ExceptHookArgs) -> None:
        """Leave out the traceback of TensorBoard's thread on a full disk: the next number that is written raises it."""
        if type(error.thread).__name__ != _THREAD or not isinstance(error.exc_value, OSError):
            self._hook(error)

    def _open(self) -> None:
        """Begin logging; loggers take a while to import."""
        from multilift_marl.agents.loggers import make_logger

        self._logger = make_logger(self._name, self._path.parent, self._purge)
        self._purge = None

    def _rewrite(self) -> None:
        self._behind = True
        text = io.StringIO(newline="")
        writer = csv.DictWriter(text, self._columns, restval="")
        writer.writeheader()
        writer.writerows(self._rows)
        write_whole(self._path, text.getvalue().encode(), flush=False)
        self._behind = False


def _tag(name: str) -> str:
    """Return the logger's tag of a number: its name, behind that of a group."""
    if "/" in name:
        return name
    return next((f"{group}/{name}" for group, names in _GROUPS.items() if name in names), f"update/{name}")


def say(text: str) -> None:
    """Show a line above the bar of a training."""
    quietly(tqdm.write, text)


def describe_evaluation(frames: int, values: dict[str, float], metric: str, header: bool) -> str:
    """Return an evaluation's row of the table that a training shows, below its header where that is asked for.

    Args:
        frames: of the training so far.
        values: of the evaluation, by name.
        metric: the error that is shown.
        header: whether it is the first.
    """
    success, error = values["eval/success_rate"], 100 * values[f"eval/{metric}"]
    bar = f"{success:>6.0%}  {'#' * round(20 * success):<20}"
    row = f"{frames:>11,}  {bar}  {error:>8.2f} cm  {values['eval/return']:>7.0f}"
    name = name_error(metric).removeprefix("position ")
    return f"{'steps':>11}  {'evaluation: success':<28}  {name:>11}  {'return':>7}\n{row}" if header else row


def quietly(show: Callable[..., object], *arguments: Any) -> None:
    """Show something on a terminal that may be gone."""
    with suppress(OSError):
        show(*arguments)


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
