"""A stand-in for DDS in one process: messages by topic, as they are."""

from __future__ import annotations

from collections import defaultdict

from multilift_marl.ros.bag import DISTRIBUTIONS
from multilift_marl.ros.types import typestore


class Wire:
    """Has the methods of `Node`.

    Attributes:
        queues: what subscriptions will return, by topic.
        sent: what was published, by topic.
    """

    store = typestore(DISTRIBUTIONS["jazzy"][0])

    def __init__(self):
        self.queues = defaultdict(list)
        self.sent = defaultdict(list)

    def publisher(self, topic):
        return self.sent[topic.name].append

    def subscription(self, topic):
        def take():
            taken, self.queues[topic.name] = self.queues[topic.name], []
            return taken

        return take

    def wait(self, seconds):
        return True
