"""Messages of others, from bytes: what cannot be read, or cannot be true, is counted and left out."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
from rosbags.typesys.store import Typestore

from multilift_marl.deploy.ros.messages import Topic
from multilift_marl.errors import reason, shorten

_LOGGER = logging.getLogger(__name__)


class Reader:
    """Reads what arrives on topics.

    Args:
        store: types of a ROS distribution.

    Attributes:
        left_out: messages that could not be read, by topic.
    """

    def __init__(self, store: Typestore):
        self._store = store
        self.left_out: Counter[str] = Counter()

    def read(self, topic: Topic, convert: Callable[[Any], Any], samples: Iterable[bytes]) -> list[Any]:
        """Return what `convert` makes of the messages in some samples (CDR) of a topic, without those that fail.

        The first of a topic that fails is said, all are counted.
        """
        found = []
        for data in samples:
            try:
                with np.errstate(over="ignore", invalid="ignore"):
                    found.append(convert(self._store.deserialize_cdr(data, topic.kind)))
            except Exception as error:  # rosbags generates its decoders: bytes of others may fail in any way
                if topic.name not in self.left_out:
                    why = shorten(reason(error), 200)
                    _LOGGER.warning("what cannot be read on %s is left out; the first: %s", topic.name, why)
                self.left_out[topic.name] += 1
        return found
