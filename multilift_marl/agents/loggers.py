"""Where a training's numbers go: TorchRL's loggers of TensorBoard, Weights & Biases and CSV files (`train.logger`)."""

from __future__ import annotations

import re
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Protocol

import imageio.v3 as iio
from torch.utils.tensorboard import SummaryWriter
from torch.utils.tensorboard.summary import hparams
from torchrl.record.loggers import CSVLogger, TensorboardLogger, WandbLogger

from multilift_marl.config.config import Config
from multilift_marl.errors import ConfigError, reason

_SECTIONS = ("env", "control", "reward", "train")  # of the configuration that count as hyperparameters, beside
_KEYS = ("task", "seed")
_RESULTS = (  # that TensorBoard shows beside them
    "eval/success_rate", "eval/payload_position_error_m", "eval/return", "final/learned_success_rate",
    "final/learned_payload_position_error_m", "eval/payload_rmse_m", "final/learned_payload_rmse_m", "final/gained",
)  # fmt: skip


class Logger(Protocol):
    """A logger of TorchRL, and what it does not define for all of them."""

    def log_metrics(self, metrics: dict[str, Any], step: int | None = None) -> Any:
        """Log numbers by tag."""

    def log_hparams(self, cfg: dict[str, Any]) -> None:
        """Log the hyperparameters by name."""

    def log_text(self, tag: str, text: str, step: int) -> None:
        """Log a text as it is."""

    def log_picture(self, tag: str, path: Path, step: int) -> None:
        """Log a picture file, where pictures can be logged."""

    def close(self) -> None:
        """Write all and end."""


class _TensorBoard(TensorboardLogger):
    """Event files in the run's folder; what was logged from step `purge` on is dropped."""

    def __init__(self, folder: Path, purge: int | None):
        self._purge = purge
        super().__init__(exp_name=folder.name, log_dir=str(folder.parent))

    def _create_experiment(self) -> SummaryWriter:
        return SummaryWriter(str(Path(self.log_dir, self.exp_name)), purge_step=self._purge)

    def log_hparams(self, cfg: dict[str, Any]) -> None:
        """Log them beside the scalars of this run; `SummaryWriter.add_hparams` makes a run of their own."""
        for summary in hparams(cfg, dict.fromkeys(_RESULTS, 0.0)):
            self.experiment.file_writer.add_summary(summary)

    def log_text(self, tag: str, text: str, step: int) -> None:
        self.experiment.add_text(tag, "\n".join("    " + line for line in text.splitlines()), step)

    def log_picture(self, tag: str, path: Path, step: int) -> None:
        self.experiment.add_image(tag, iio.imread(path), step, dataformats="HWC")


class _WandB(WandbLogger):
    """A run of Weights & Biases with the name of the run's folder, which goes on where that is resumed."""

    def __init__(self, folder: Path):
        name = re.sub(r"[^\w.-]", "-", folder.name)
        super().__init__(
            exp_name=folder.name, log_dir=str(folder), id=name, project="multilift_marl", log_env_packages=False
        )

    def log_text(self, tag: str, text: str, step: int) -> None:
        self.experiment.config.update({tag: text}, allow_val_change=True)

    def log_picture(self, tag: str, path: Path, step: int) -> None:
        self._log_payload({f"pictures/{tag}": import_module("wandb").Image(str(path))}, step=step)


class _CSV(CSVLogger):
    """Files of step and value for each number, in the folder `csv` of the run."""

    def __init__(self, folder: Path, purge: int | None):
        if purge is not None:
            for path in (folder / "csv" / "scalars").rglob("*.csv"):
                lines = path.read_text(encoding="utf-8").splitlines(True)
                kept = (line for line in lines if int(line.partition(",")[0]) < purge)
                path.write_text("".join(kept), encoding="utf-8")
        super().__init__(exp_name="csv", log_dir=str(folder))

    def log_text(self, tag: str, text: str, step: int) -> None:
        self.experiment.add_text(tag, text, global_step=step)

    def log_picture(self, tag: str, path: Path, step: int) -> None:
        """Do nothing: the file is in the run's folder."""


def check_logger(name: str) -> None:
    """Refuse, by a ConfigError, a logger whose package is missing."""
    if name in ("wandb", "tensorboard") and find_spec(name) is None:
        raise ConfigError(f"train.logger={name} needs the package {name}: pip install {name}, or set train.logger=csv")


def make_logger(name: str, folder: Path, purge: int | None) -> Logger:
    """Return the logger of a run.

    Args:
        name: `train.logger`.
        folder: the run's.
        purge: first step that is dropped of what a stopped run has logged, where that can be; None for none.

    Raises:
        ConfigError: W&B refuses the run, for it has no key, say.
        OSError: the folder cannot be written.
    """
    check_logger(name)
    if name == "tensorboard":
        return _TensorBoard(folder, purge)
    if name == "csv":
        return _CSV(folder, purge)
    try:
        return _WandB(folder)
    except import_module("wandb").Error as error:
        why = reason(error).partition(". ")[0].rstrip(".")
        raise ConfigError(
            f"train.logger=wandb cannot begin a run ({why}); log in by wandb login, or set WANDB_MODE=offline in the "
            "environment"
        ) from error


def hyperparameters(config: Config) -> dict[str, Any]:
    """Return what a run is compared by: numbers, truth values and texts by dotted name."""
    values = config.model_dump(mode="json")
    found = {key: values[key] for key in _KEYS}
    for section in _SECTIONS:
        found |= _flatten(values[section], section)
    return found


def _flatten(value: Any, name: str) -> dict[str, Any]:
    if isinstance(value, dict) and value:
        return {key: each for part in value for key, each in _flatten(value[part], f"{name}.{part}").items()}
    return {name: value if isinstance(value, (bool, int, float, str)) else str(value)}
