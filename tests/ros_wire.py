"""A stand-in for DDS in one process: messages by topic, which cross as bytes."""

from __future__ import annotations

from collections import defaultdict

from multilift_marl.deploy.ros.bag import DISTRIBUTIONS
from multilift_marl.deploy.ros.reading import Reader
from multilift_marl.deploy.ros.types import typestore


class Wire:
    """Has the methods of `Node`.

    Attributes:
        topics: those that are subscribed to, by name.
        queues: what subscriptions will return, by topic: messages or their bytes, which are read as `Node` reads them.
        sent: what was published, by topic.
        reader: as that of `Node`.
    """

    store = typestore(DISTRIBUTIONS["jazzy"][0])

    def __init__(self):
        self.topics = {}
        self.queues = defaultdict(list)
        self.sent = defaultdict(list)
        self.reader = Reader(self.store)

    def publisher(self, topic):
        def publish(message):
            self.store.serialize_cdr(message, topic.kind)  # which refuses what cannot be
            self.sent[topic.name].append(message)

        return publish

    def subscription(self, topic, convert=lambda message: message):
        self.topics[topic.name] = topic

        def take():
            taken, self.queues[topic.name] = self.queues[topic.name], []
            return self.reader.read(topic, convert, [self.encode(topic.name, each) for each in taken])

        return take

    def encode(self, name, message) -> bytes:
        """Return the bytes of a message on a topic that is subscribed to; of bytes themselves."""
        if isinstance(message, bytes):
            return message
        return bytes(self.store.serialize_cdr(message, self.topics[name].kind))

    def check_publishers(self):
        pass

    def wait(self, seconds):
        return True
