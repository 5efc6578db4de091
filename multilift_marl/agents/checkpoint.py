"""Checkpoints that survive anything: written aside, flushed, renamed; read back with a clear word when they are bad."""

from __future__ import annotations

import os
import zipfile
from pathlib import Path
from typing import Any

import torch

from multilift_marl.errors import CheckpointError

FORMAT = "multilift_marl checkpoint 1"


def save_checkpoint(path: Path, content: dict[str, Any]) -> None:
    """Write `content` (tensors, numbers, text and containers of them) to `path`, atomically."""
    aside = path.with_suffix(".tmp")
    with open(aside, "wb") as file:
        torch.save({"format": FORMAT, **content}, file)
        file.flush()
        os.fsync(file.fileno())
    os.replace(aside, path)


def load_checkpoint(path: str | Path) -> dict[str, Any]:
    """Return what `save_checkpoint` wrote.

    Raises:
        CheckpointError: the file is missing, truncated or of another program.
    """
    path = Path(path)
    if not path.is_file():
        raise CheckpointError(
            f"no checkpoint {path}: give a run folder, one of its checkpoints or a shipped policy's name"
        )
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch raises many kinds for damaged files
        whole = zipfile.is_zipfile(path)
        reason = "holds more than tensors and numbers" if whole else "is truncated or no checkpoint at all"
        raise CheckpointError(
            f"{path} {reason}; use another checkpoint of the run, such as best.pt or last.pt"
        ) from error
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise CheckpointError(f"{path} was not written by multilift_marl (or by another version); train again")
    return content


def find_run(name: str | Path, runs: Path = Path("runs")) -> Path:
    """Return the folder of a run by path, by name under `runs`, or the "latest".

    Raises:
        CheckpointError: there is none.
    """
    if str(name) == "latest":
        found = sorted(runs.glob("*/checkpoints/last.pt"), key=lambda path: path.stat().st_mtime)
        if not found:
            raise CheckpointError(f"no run with a checkpoint in {runs}/: train one first, python train.py config=hover")
        return found[-1].parents[1]
    for folder in (Path(name), runs / name):
        if folder.is_dir():
            return folder
    raise CheckpointError(f"no run folder {name}: give the path of one, such as runs/<name>, or 'latest'")
