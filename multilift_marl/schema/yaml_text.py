"""YAML as it is read and written here: the plain part of it, with the numbers of YAML 1.2."""

from __future__ import annotations

import re
from copy import deepcopy
from functools import lru_cache
from pathlib import Path
from typing import Any, ClassVar

import yaml

_MOST_NODES, _MOST_DEPTH, _MOST_BYTES = 20_000, 30, 1_000_000
_INT, _FLOAT = "tag:yaml.org,2002:int", "tag:yaml.org,2002:float"
_NUMBERS = {
    _INT: re.compile(r"[-+]?[0-9]+$|0o[0-7]+$|0x[0-9a-fA-F]+$"),
    _FLOAT: re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?$|[-+]?\.(inf|Inf|INF)$|\.(nan|NaN|NAN)$"),
}
_OTHERS = (_INT, _FLOAT, "tag:yaml.org,2002:timestamp", "tag:yaml.org,2002:value")  # what YAML 1.1 makes of text


class _Loader(yaml.SafeLoader):
    """Refuses what no configuration needs: tags, keys given twice, cycles, and aliases that grow without bounds."""

    yaml_implicit_resolvers: ClassVar[dict[str, Any]] = {
        first: [(tag, pattern) for tag, pattern in known if tag not in _OTHERS]
        for first, known in yaml.SafeLoader.yaml_implicit_resolvers.items()
    }

    def __init__(self, text: str):
        super().__init__(text)
        self._nodes = self._depth = 0
        self._sizes: dict[str, int] = {}  # of anchors, in nodes

    def compose_node(self, parent: Any, index: Any) -> Any:
        """Return the next node, counted as if aliases were written out."""
        event = self.peek_event()
        if getattr(event, "tag", None) is not None:
            raise _fault(event, f"the tag {event.tag} is not taken")
        if isinstance(event, yaml.AliasEvent):
            if event.anchor in self.anchors and event.anchor not in self._sizes:
                raise _fault(event, f"*{event.anchor} holds itself")
            self._nodes += self._sizes.get(event.anchor, 0)
        self._nodes, self._depth = self._nodes + 1, self._depth + 1
        if self._nodes > _MOST_NODES:
            raise _fault(event, f"more than {_MOST_NODES} values")
        if self._depth > _MOST_DEPTH:
            raise _fault(event, f"nested more than {_MOST_DEPTH} deep")
        before = self._nodes
        node = super().compose_node(parent, index)
        self._depth -= 1
        if not isinstance(event, yaml.AliasEvent) and event.anchor is not None:
            self._sizes[event.anchor] = self._nodes - before + 1
        return node

    def compose_mapping_node(self, anchor: Any) -> Any:
        """Return a mapping whose keys differ."""
        node = super().compose_mapping_node(anchor)
        known = set()
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode):
                if key.value in known:
                    raise _fault(key, f"'{key.value}' is given twice")
                known.add(key.value)
        return node

    def construct_int(self, node: Any) -> int:
        """Return a whole number as YAML 1.2 reads it."""
        try:
            return int(node.value, {"0x": 16, "0o": 8}.get(node.value[:2], 10))
        except ValueError:  # thousands of digits
            raise _fault(node, "a number has too many digits") from None


class _Dumper(yaml.SafeDumper):
    """Quotes text that any reader of YAML takes for something else."""


for _tag, _pattern in _NUMBERS.items():
    for _class in (_Loader, _Dumper):
        _class.add_implicit_resolver(_tag, _pattern, list("-+.0123456789"))
_Loader.add_constructor(_INT, _Loader.construct_int)


def parse_yaml(text: str) -> Any:
    """Return what YAML holds.

    Raises:
        ValueError: it is no YAML, or more than a configuration needs; one sentence without an end.
    """
    return deepcopy(_parse(text))


@lru_cache(maxsize=64)  # configurations that each other is based on are read again and again
def _parse(text: str) -> Any:
    try:
        loader = _Loader(text)
        try:
            return loader.get_single_data()
        finally:
            loader.dispose()
    except yaml.YAMLError as error:
        raise ValueError(" ".join(str(error).split())) from None


def read_yaml(path: Path) -> Any:
    """Return what a YAML file holds.

    Raises:
        FileNotFoundError: there is none.
        OSError: it cannot be read.
        ValueError: see `parse_yaml`; or it is no regular file, too long, or not in UTF-8.
    """
    if path.exists() and not path.is_file():
        raise ValueError("it is no regular file")
    with open(path, "rb") as file:
        content = file.read(_MOST_BYTES + 1)
    if len(content) > _MOST_BYTES:
        raise ValueError(f"it is longer than {_MOST_BYTES} bytes")
    return parse_yaml(content.decode())


def write_yaml(values: Any) -> str:
    """Return values as YAML."""
    return yaml.dump(values, Dumper=_Dumper, sort_keys=False)


def _fault(place: Any, words: str) -> yaml.YAMLError:
    return yaml.YAMLError(f"{words} (line {place.start_mark.line + 1})")
