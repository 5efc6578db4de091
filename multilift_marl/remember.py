"""Results that are kept by the values of arguments: environments of one configuration share what their rig leads to."""

from __future__ import annotations

import hashlib
import pickle
from collections import OrderedDict
from collections.abc import Callable
from functools import wraps
from typing import ParamSpec, TypeVar

P = ParamSpec("P")
R = TypeVar("R")
_MOST = 32  # results of a function


def remember(function: Callable[P, R]) -> Callable[P, R]:
    """Keep a function's last results, by the values of its arguments; nobody may change what it returns.

    `functools.lru_cache` cannot: it takes no arrays, and compares a `System` by identity.
    """
    kept: OrderedDict[bytes, tuple[R]] = OrderedDict()

    @wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        key = hashlib.sha256(pickle.dumps((args, kwargs))).digest()
        found = kept.pop(key, None) or (function(*args, **kwargs),)
        kept[key] = found  # as the last one
        if len(kept) > _MOST:
            kept.popitem(last=False)
        return found[0]

    return call
