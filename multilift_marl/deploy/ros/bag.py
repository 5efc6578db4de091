"""Bags of a flight, for `ros2 bag`, Foxglove, PlotJuggler and RViz."""

from __future__ import annotations

import shutil
from pathlib import Path
from types import TracebackType

import numpy as np
from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores

from multilift_marl._files import check_writable, name_aside
from multilift_marl.deploy.ros.messages import FlightMessages, Topic
from multilift_marl.deploy.ros.types import typestore
from multilift_marl.envs.core import MultiliftVec
from multilift_marl.errors import ConfigError, reason

DISTRIBUTIONS = {
    "humble": (Stores.ROS2_HUMBLE, StoragePlugin.SQLITE3, 8),
    "jazzy": (Stores.ROS2_JAZZY, StoragePlugin.MCAP, 9),
    "kilted": (Stores.ROS2_KILTED, StoragePlugin.MCAP, 9),
    "lyrical": (Stores.ROS2_LYRICAL, StoragePlugin.MCAP, 9),
}
"""Types, storage and version of the bags of each ROS distribution: what its `ros2 bag` reads without a plugin."""


class BagWriter:
    """Writes a flight of environment 0, its start at once; a context that closes the bag.

    The bag is there when it is whole: written aside, renamed at the end. Where its context ends by an error, what was
    recorded until then is in the folder of its name with `_partial`, in place of what an earlier flight left there.

    Args:
        folder: of the bag, which must not be there yet.
        vec: the environments, after a reset.
        distribution: a key of `DISTRIBUTIONS`.
        names: a key of `messages.NAMES`.

    Raises:
        ConfigError: the folder is there already, or cannot be made.
    """

    def __init__(self, folder: Path, vec: MultiliftVec, distribution: str = "jazzy", names: str = "multilift"):
        types, storage, version = DISTRIBUTIONS[distribution]
        self._store = typestore(types)
        self._messages = FlightMessages(vec, self._store, names)
        check_free(folder)
        self._folder, self._aside = folder, name_aside(folder)
        try:
            self._open(version, storage)
            self.write(0.0)
        except OSError as error:
            shutil.rmtree(self._aside, ignore_errors=True)
            raise ConfigError(f"cannot write bag={folder} ({reason(error)}); give another folder") from error
        except BaseException:
            shutil.rmtree(self._aside, ignore_errors=True)
            raise

    def _open(self, version: int, storage: StoragePlugin) -> None:
        """Begin a bag by its own name, which its files have too, in a folder aside."""
        self._aside.mkdir(parents=True)
        self._writer = Writer(self._aside / self._folder.name, version=version, storage_plugin=storage)  # type: ignore[arg-type]
        self._writer.open()
        self._connections = {
            topic.name: self._writer.add_connection(
                topic.name, topic.kind, typestore=self._store, offered_qos_profiles=[_qos(topic)]
            )
            for topic in self._messages.topics()
        }

    def write(self, seconds: float) -> None:
        """Write the state as it is, at a time since the start [s]."""
        time_ns = round(seconds * 1e9)
        for topic, message in self._messages.messages(time_ns):
            connection = self._connections[topic]
            self._writer.write(connection, time_ns, self._store.serialize_cdr(message, connection.msgtype))

    def __enter__(self) -> BagWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        try:
            self._writer.close()
            folder = self._folder
            if kind is not None:
                folder = folder.with_name(f"{folder.name}_partial")
                shutil.rmtree(folder, ignore_errors=True)
            (self._aside / self._folder.name).rename(folder)
        finally:
            shutil.rmtree(self._aside, ignore_errors=True)


def check_free(folder: Path) -> None:
    """Refuse, by a ConfigError, a folder that is there already, as bags are never overwritten, or cannot be made."""
    if folder.exists():
        raise ConfigError(f"bag={folder} is there already; give a folder that is not")
    try:
        check_writable(folder.parent)
    except (OSError, ValueError) as error:
        raise ConfigError(f"bag={folder} cannot be written ({reason(error)}); give another folder") from error


def _qos(topic: Topic) -> Qos:
    """Return the quality of service that a topic is offered with: the last message, as simulations publish."""
    forever = QosTime(2147483647, 4294967295)
    deadline = QosTime(0, round(1e9 * topic.deadline)) if np.isfinite(topic.deadline) else forever
    return Qos(
        QosHistory.KEEP_LAST,
        1 if topic.latched or not topic.reliable else 10,
        QosReliability.RELIABLE if topic.reliable else QosReliability.BEST_EFFORT,
        QosDurability.TRANSIENT_LOCAL if topic.latched else QosDurability.VOLATILE,
        deadline,
        forever,
        QosLiveliness.AUTOMATIC,
        forever,
        False,
    )
