"""Checkpoints that survive anything: written aside, flushed, renamed; verified when read; one writer for each run."""

from __future__ import annotations

import io
import os
import re
import zipfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import torch

from multilift_marl._files import write_whole
from multilift_marl._platform import lock_file
from multilift_marl.errors import CheckpointError, ConfigError, reason

FORMAT = "multilift_marl checkpoint 1"
_STAMP = re.compile(r"-(\d{8}-\d{6})-s\d+(?:-(\d+))?$")  # of a run's name: time, and which run of that second
_locks: dict[Path, int] = {}  # runs that this process trains: folder, descriptor of the lock


def save_checkpoint(path: Path, content: dict[str, Any]) -> None:
    """Write `content` (tensors, numbers, text and containers of them) to `path`, atomically.

    Raises:
        CheckpointError: it cannot be written; what was there before is still there.
    """
    data = io.BytesIO()
    torch.save({"format": FORMAT, **content}, data)
    try:
        write_whole(path, data.getbuffer())
    except OSError as error:
        raise CheckpointError(f"cannot write {path} ({reason(error)}); make room there, or use another disk") from error


def load_checkpoint(path: str | Path) -> dict[str, Any]:
    """Return what `save_checkpoint` wrote.

    Raises:
        CheckpointError: the file is missing, truncated, damaged or of another program.
    """
    path = Path(path)
    try:
        if not path.is_file():
            raise CheckpointError(
                f"no checkpoint {path}: give a run folder, one of its checkpoints or a shipped policy's name"
            )
        data = path.read_bytes()
    except (OSError, ValueError) as error:  # ValueError: a name with a NUL
        raise CheckpointError(f"cannot read {path} ({reason(error)}); give another checkpoint") from error
    return parse_checkpoint(data, path)


def parse_checkpoint(content: bytes, path: Path) -> dict[str, Any]:
    """Return what `save_checkpoint` wrote, from the content of the file `path`; see `load_checkpoint`."""
    data = io.BytesIO(content)
    other = "use another checkpoint of the run, such as best.pt or last.pt"
    if not zipfile.is_zipfile(data):
        raise CheckpointError(f"{path} is truncated or no checkpoint at all; {other}")
    try:
        with zipfile.ZipFile(data) as archive:  # torch does not compare the checksums
            damaged = archive.testzip()
    except Exception as error:  # zipfile raises many kinds for damaged headers
        raise CheckpointError(f"{path} is damaged; {other}") from error
    if damaged is not None:
        raise CheckpointError(f"{path} is damaged (wrong checksum of {damaged}); {other}")
    try:
        data.seek(0)
        # weights_only: a pickle may run any program when it is loaded.
        found = torch.load(data, map_location="cpu", weights_only=True)
    except Exception as error:  # torch does so for what it cannot take
        raise CheckpointError(f"{path} holds more than tensors and numbers; {other}") from error
    if not isinstance(found, dict) or found.get("format") != FORMAT:
        raise CheckpointError(f"{path} was not written by multilift_marl (or by another version); train again")
    return found


def saved_iteration(path: Path) -> int | None:
    """Return the iteration of a run's checkpoint, None where there is none that can be read."""
    try:
        iteration: int | None = load_checkpoint(path).get("iteration")
    except CheckpointError:
        return None
    return iteration


def copy_content(content: Any) -> Any:
    """Return the content of a checkpoint with copies of its tensors, which training changes."""
    if isinstance(content, torch.Tensor):
        return content.clone()
    if isinstance(content, dict):
        return {key: copy_content(value) for key, value in content.items()}
    return [copy_content(value) for value in content] if isinstance(content, list) else content


def check_like(found: Any, expected: Any, name: str) -> None:
    """Refuse what is not built as `expected` is: types, keys, shapes; and numbers that are not finite.

    Raises:
        ValueError: naming the part.
    """
    if type(found) is not type(expected) and not (isinstance(found, dict) and isinstance(expected, dict)):
        raise ValueError(f"'{name}' is {type(found).__name__}, expected {type(expected).__name__}")
    if isinstance(expected, torch.Tensor):
        for what in ("dtype", "shape"):
            mine, its = getattr(expected, what), getattr(found, what)
            if mine != its:
                shown = (tuple(its), tuple(mine)) if what == "shape" else (its, mine)
                raise ValueError(f"'{name}' has {what} {shown[0]}, expected {shown[1]}")
        if not torch.isfinite(found).all():
            raise ValueError(f"'{name}' holds NaN or infinite numbers")
    elif isinstance(expected, dict):
        for key in sorted(expected.keys() ^ found.keys(), key=str):
            raise ValueError(f"'{name}.{key}' is {'missing' if key in expected else 'unknown'}")
        for key, value in expected.items():
            check_like(found[key], value, f"{name}.{key}")
    elif isinstance(expected, list | tuple):
        if len(found) != len(expected):
            raise ValueError(f"'{name}' has {len(found)} entries, expected {len(expected)}")
        for i, (mine, its) in enumerate(zip(expected, found, strict=True)):
            check_like(its, mine, f"{name}.{i}")
    elif isinstance(found, float) and found != found:
        raise ValueError(f"'{name}' is NaN")


def find_run(name: str | Path, runs: Path = Path("runs"), others: Iterable[str] = ()) -> Path:
    """Return the folder of a run by path, by name under `runs`, or the "latest", by the time in its name.

    Args:
        name: of the run.
        runs: folder of runs.
        others: names that the caller knows beside them, for messages.

    Raises:
        CheckpointError: there is none.
    """
    try:
        if str(name) == "latest":
            found = [folder for folder in runs.iterdir() if (folder / "checkpoints" / "last.pt").is_file()]
            if found:
                return max(found, key=_age)
        else:
            here = [folder for folder in (Path(name), runs / name) if str(name) and folder.is_dir()]
            if here:  # the run, if another folder has its name
                return next((folder for folder in here if (folder / "checkpoints").is_dir()), here[0])
    except FileNotFoundError:
        pass
    except (OSError, ValueError) as error:
        raise CheckpointError(
            f"cannot look for run {str(name)!r} ({reason(error)}); give the path of a run folder"
        ) from error
    if str(name) == "latest":
        raise CheckpointError(f"no run with a checkpoint in {runs}/: train one first, python train.py config=hover")
    known = [*others, *(folder.name for folder in runs.glob("*/") if (folder / "checkpoints").is_dir())]
    close = get_close_matches(str(name), known, n=1, cutoff=0.7)
    hint = f"; did you mean '{close[0]}'?" if close else ""
    raise CheckpointError(f"no run folder {name}: give the path of one, such as runs/<name>, or 'latest'{hint}")


def _age(folder: Path) -> tuple[str, int, str]:
    stamp = _STAMP.search(folder.name)
    return (stamp[1], int(stamp[2] or 1), folder.name) if stamp else ("", 0, folder.name)


@contextmanager
def making_run(runs: Path) -> Iterator[None]:
    """Say by a ConfigError that a run cannot be made in `runs`."""
    try:
        yield
    except OSError as error:
        raise ConfigError(f"cannot make a run in {runs}/ ({reason(error)}); train in another folder") from error


def lock_run(folder: Path) -> None:
    """Make this process the only one that trains `folder`, until `unlock_run` or its end.

    Raises:
        CheckpointError: another process trains it.
    """
    folder = folder.resolve()
    if folder in _locks:
        return
    file = os.open(folder / "lock", os.O_RDWR | os.O_CREAT, 0o666)
    try:
        lock_file(file)
    except OSError as error:
        owner = os.read(file, 20).decode(errors="replace")
        os.close(file)
        raise CheckpointError(
            f"{folder} is being trained by another process ({owner or 'unknown'}); wait for its end, or start a new run"
        ) from error
    os.ftruncate(file, 0)
    os.write(file, str(os.getpid()).encode())
    _locks[folder] = file


def unlock_run(folder: Path) -> None:
    """Let other processes train `folder` again."""
    file = _locks.pop(folder.resolve(), None)
    if file is not None:
        os.close(file)


def clear_leftovers(folder: Path) -> None:
    """Delete what writers that were killed have left in `folder`, which must be locked."""
    for path in (*folder.glob("*.tmp"), *(folder / "checkpoints").glob("*.tmp")):
        path.unlink(missing_ok=True)
