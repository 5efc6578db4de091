"""A browser's part of the viewer's page: what its websocket sends, by viser's format."""

from __future__ import annotations

import time

import numpy as np


class PagePeer:
    """Hears a page.

    Args:
        address: of the page, with its token.

    Attributes:
        nodes: properties of what is drawn, by name.
        texts: contents of the panel's texts, by identifier.
    """

    def __init__(self, address: str):
        import viser
        from websockets.sync.client import connect

        self.nodes, self.texts = {}, {}
        version = [f"viser-v{viser.__version__}"]
        self._socket = connect(address.replace("http", "ws"), max_size=None, subprotocols=version)

    def hear(self, seconds: float = 0.0) -> None:
        """Take in what comes within some seconds."""
        end = time.monotonic() + seconds
        while True:
            try:
                self._read(self._socket.recv(timeout=max(end - time.monotonic(), 0.01)))
            except TimeoutError:
                return

    def until(self, condition, seconds: float = 30.0) -> bool:
        """Hear until a condition holds; return whether it does."""
        end = time.monotonic() + seconds
        while not condition() and time.monotonic() < end:
            self.hear(0.05)
        return condition()

    def positions(self) -> np.ndarray:
        """Return the positions (K, 3) [m] of all that is drawn in batches, and has a size."""
        found = [np.zeros((0, 3))]
        for node in self.nodes.values():
            if "batched_positions" in node:
                places, sizes = (node[f"batched_{name}"].reshape(-1, 3) for name in ("positions", "scales"))
                found.append(places[(sizes > 0).any(axis=1)])
        return np.concatenate(found)

    def text(self) -> str:
        """Return the panel's texts."""
        return "\n".join(self.texts.values())

    def close(self) -> None:
        """Leave."""
        self._socket.close()

    def _read(self, data: bytes) -> None:
        import msgspec
        import zstandard

        size, packed = int.from_bytes(data[:8], "little"), int.from_bytes(data[8:16], "little")
        window = msgspec.msgpack.decode(zstandard.ZstdDecompressor().decompress(data[16 : 16 + packed], size))
        buffers, at = [], 16 + packed
        for length in window["binaryBufferLengths"]:
            at += -at % 8
            buffers.append(data[at : at + length])
            at += length
        for message in window["messages"]:
            self._take(_unpack(message, buffers))

    def _take(self, message: dict) -> None:
        kind = message["type"]
        if kind == "BatchedMeshesMessage":
            self.nodes[message["name"]] = message["props"]
        elif kind == "SceneNodeUpdateMessage":
            self.nodes.setdefault(message["name"], {}).update(message["updates"])
        elif kind == "RemoveSceneNodeMessage":
            self.nodes.pop(message["name"], None)
        elif kind == "GuiMarkdownMessage":
            self.texts[message["uuid"]] = message["props"]["_markdown"]
        elif kind == "GuiUpdateMessage" and message["uuid"] in self.texts:
            self.texts[message["uuid"]] = message["updates"].get("_markdown", self.texts[message["uuid"]])


def _unpack(value, buffers: list[bytes]):
    """Return a value of a message with the arrays, all flat, in place of their numbers."""
    if not isinstance(value, dict):
        return value
    if "__binary_index" in value:
        return np.frombuffer(buffers[value["__binary_index"]], value["dtype"])
    return {key: _unpack(part, buffers) for key, part in value.items()}
