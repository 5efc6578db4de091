"""ROS 2 topics by DDS (Eclipse Cyclone DDS), without ROS 2.

As in ROS 2, topics are `rt/<name>`, types `pkg::msg::dds_::Name_` (final, XCDR1), and the hash of the type is in the
user data, where Jazzy and later look for it. Bytes are those of rosbags' serializer; Cyclone DDS carries them.
"""

from __future__ import annotations

import logging
import time
import types as python_types
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsPublication
from cyclonedds.core import DDSException, InstanceState, ReadCondition, SampleState, ViewState, WaitSet
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.idl import IdlStruct, types
from cyclonedds.idl.annotations import final
from cyclonedds.pub import DataWriter
from cyclonedds.qos import Policy, Qos
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic as DdsTopic
from cyclonedds.util import duration
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores

from multilift_marl.deploy.ros.messages import Topic
from multilift_marl.deploy.ros.reading import Reader
from multilift_marl.deploy.ros.types import typestore
from multilift_marl.errors import FlightError

# Without multicast, participants find each other by the ports that belong to indices 0 to 50 of this host.
_LOOPBACK = """<CycloneDDS><Domain>
<General><Interfaces><NetworkInterface name="lo" multicast="false"/></Interfaces>
<AllowMulticast>false</AllowMulticast></General>
<Discovery><ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>50</MaxAutoParticipantIndex>
<Peers><Peer address="127.0.0.1"/></Peers></Discovery>
</Domain></CycloneDDS>"""
_BASE = {
    "bool": bool, "string": str, "byte": types.uint8, "char": types.uint8, "int8": types.int8, "uint8": types.uint8,
    "int16": types.int16, "uint16": types.uint16, "int32": types.int32, "uint32": types.uint32,
    "int64": types.int64, "uint64": types.uint64, "float32": types.float32, "float64": types.float64,
}  # fmt: skip
_LOGGER = logging.getLogger(__name__)
_LOOK = 1.0  # [s] between looks for other publishers
_MOST = 10_000  # publishers of a domain that are looked at
_SHARED = {"/tf", "/markers", "/fly"}  # which several nodes may publish
_QUEUE = 10  # messages that a reliable topic keeps
Take = Callable[[], list[Any]]
_domains: dict[int, Domain] = {}  # a process configures each once


class Node:
    """Publishes and subscribes, on this machine alone unless it is told otherwise.

    Args:
        distribution: of ROS 2, whose types and hashes these are.
        domain: number, ROS_DOMAIN_ID of its peers.
        allow_network: whether DDS may use the machine's other networks, and multicast.

    Attributes:
        store: types of the distribution.
        reader: reads what subscriptions hear, and counts what it cannot read.

    Raises:
        FlightError: DDS does not start.
    """

    def __init__(self, distribution: Stores = Stores.ROS2_JAZZY, domain: int = 0, allow_network: bool = False):
        self._published, self._heard, self._warned = set[str](), set[str](), set[str]()
        self._look_at = 0.0
        self.store = typestore(distribution)
        self.reader = Reader(self.store)
        self._distribution = distribution
        try:
            if not allow_network and domain not in _domains:
                _domains[domain] = Domain(domain, _LOOPBACK)
            self._participant = DomainParticipant(domain)
            self._arrivals = WaitSet(self._participant)
            self._publishers = BuiltinDataReader(self._participant, BuiltinTopicDcpsPublication)
            # `_changed` has what was not read yet, `_alive` all publishers that there are.
            seen = ViewState.Any | InstanceState.Any | SampleState.NotRead
            self._changed = ReadCondition(self._publishers, seen)
            self._alive = ReadCondition(self._publishers, ViewState.Any | InstanceState.Alive | SampleState.Any)
        except DDSException as error:
            raise FlightError(
                f"DDS does not start in domain {domain} ({error.msg}); take another one, or end what uses its ports"
            ) from None

    def publisher(self, topic: Topic) -> Callable[[Any], None]:
        """Return the call that publishes a message of rosbags' on a topic."""
        kind = _carrier(self._distribution, topic.kind)
        quality = self._quality(topic)
        writer = DataWriter(self._participant, DdsTopic(self._participant, f"rt{topic.name}", kind), quality)
        carrier = kind()
        self._published.add(topic.name)

        def publish(message: Any) -> None:
            carrier.data = bytes(self.store.serialize_cdr(message, topic.kind))
            writer.write(carrier)

        return publish

    def subscription(self, topic: Topic, convert: Callable[[Any], Any] = lambda message: message) -> Take:
        """Return the call that returns the messages of a topic that have come since the last call.

        Args:
            topic: to hear.
            convert: makes what is returned of each message; a ValueError leaves it out, see `Reader`.
        """
        kind = _carrier(self._distribution, topic.kind)
        quality = self._quality(topic)
        reader = DataReader(self._participant, DdsTopic(self._participant, f"rt{topic.name}", kind), quality)
        self._heard.add(topic.name)
        self._arrivals.attach(ReadCondition(reader, ViewState.Any | InstanceState.Any | SampleState.NotRead))

        def take() -> list[Any]:
            samples = (sample for sample in reader.take(_QUEUE) if isinstance(sample, kind))  # others say who has gone
            return self.reader.read(topic, convert, (sample.data for sample in samples))

        return take

    def wait(self, seconds: float) -> bool:
        """Wait until a subscription has something new, for some seconds at most; return whether one has."""
        return self._arrivals.wait(duration(seconds=seconds)) > 0

    def check_publishers(self) -> None:
        """Warn, once, of topics that this node and others publish, and of those that it hears from several."""
        now = time.monotonic()
        if now < self._look_at:
            return
        self._look_at = now + _LOOK
        # To read marks as read: without anything new since the last time the long list is not gone through.
        if not self._publishers.read(_MOST, self._changed):
            return
        others: dict[str, set[Any]] = {}
        for found in self._publishers.read(_MOST, self._alive):
            if found.participant_key != self._participant.guid:
                others.setdefault(found.topic_name.removeprefix("rt"), set()).add(found.participant_key)
        several = {name for name, nodes in others.items() if name in self._published or len(nodes) > 1}
        new = (several & (self._published | self._heard)) - _SHARED - self._warned
        if new:
            self._warned |= new
            names = ", ".join(sorted(new)[:3]) + f" and {len(new) - 3} more" * (len(new) > 3)
            _LOGGER.warning(
                "several nodes of this domain publish %s, so that two may fly one team; end one, or give it another "
                "domain=", names,
            )  # fmt: skip

    def _quality(self, topic: Topic) -> Qos:
        """Return the quality of service of a topic, with the hash of its type."""
        typehash = f"typehash={self.store.hash_rihs01(topic.kind)};".encode()
        promise = [Policy.Deadline(duration(seconds=topic.deadline))] if np.isfinite(topic.deadline) else []
        return Qos(
            *promise,
            Policy.Reliability.Reliable(duration(seconds=1)) if topic.reliable else Policy.Reliability.BestEffort,
            Policy.Durability.TransientLocal if topic.latched else Policy.Durability.Volatile,
            Policy.History.KeepLast(_QUEUE if topic.reliable and not topic.latched else 1),
            Policy.DataRepresentation(use_cdrv0_representation=True),
            Policy.Userdata(typehash),
        )


def describe_reach(domain: int, allow_network: bool, distribution: str) -> str:
    """Return in which domain a node is, who hears it, and what nodes of a distribution of ROS 2 need for that."""
    humble = distribution == "humble"
    setting = "ROS_LOCALHOST_ONLY" if humble else "ROS_AUTOMATIC_DISCOVERY_RANGE"
    where, value = (
        ("all networks", " unset") if allow_network else ("this machine alone", "=1" if humble else "=LOCALHOST")
    )
    return f"in domain {domain}, for {where}; ROS 2 nodes need {setting}{value}"


@cache
def _carrier(distribution: Stores, kind: str) -> Any:
    """Return a class with the DDS type of a message, whose instances carry its bytes as they are."""
    described = _idl_type(distribution, kind)

    class Carrier(described):  # type: ignore[misc, valid-type]
        data = b""

        def __init__(self) -> None:
            pass

        def serialize(self, *_: Any, **__: Any) -> bytes:
            return self.data

        @classmethod
        def deserialize(cls, data: bytes, *_: Any, **__: Any) -> Carrier:
            sample = cls()
            sample.data = bytes(data)
            return sample

    Carrier.__idl__ = described.__idl__
    return Carrier


@cache
def _idl_type(distribution: Stores, kind: str) -> Any:
    """Return the DDS type of a message."""
    package, _, name = kind.split("/")
    fields = typestore(distribution).fielddefs[kind][1]
    members = {field: _idl_field(distribution, description) for field, description in fields}

    def fill(namespace: dict[str, Any]) -> None:
        namespace |= {"__annotations__": members, "__module__": __name__}

    created: Any = python_types.new_class(f"{name}_", (IdlStruct,), {"typename": f"{package}.msg.dds_.{name}_"}, fill)
    return final(dataclass(created)) or created


def _idl_field(distribution: Stores, description: Any) -> Any:
    node, argument = description
    if node == Nodetype.BASE:
        return _BASE[argument[0]]
    if node == Nodetype.NAME:
        return _idl_type(distribution, argument)
    element = _idl_field(distribution, argument[0])
    array: Any = types.array
    sequence: Any = types.sequence
    return array[element, argument[1]] if node == Nodetype.ARRAY else sequence[element]
