"""Policy files as somebody with bad intentions would make them."""

from __future__ import annotations

import base64
import json
import pickle
from pathlib import Path
from typing import Any

from surrogym_shared.archives import read_entries, stored

LIMIT = 256 * 1024 * 1024


class Touches:
    """Unpickling it makes a file: what a gift's code could do."""

    def __init__(self, mark: Path) -> None:
        self._mark = mark

    def __reduce__(self) -> tuple[Any, ...]:
        return Path.touch, (self._mark,)


def pickled(mark: Path) -> dict[str, str]:
    """An object as Stable-Baselines3 writes those that are no JSON."""
    return {":type:": "a gift", ":serialized:": base64.b64encode(pickle.dumps(Touches(mark))).decode()}


def gift(policy: Path, mark: Path) -> Path:
    """A policy's file whose reader makes ``mark``, if it unpickles."""
    policy.write_bytes(stored({"data": json.dumps({"policy_class": pickled(mark)}).encode()}))
    return policy


def changed(policy: Path, **entries: bytes) -> Path:
    """A policy's file with other entries; their names have ``__`` for a dot."""
    given = {name.replace("__", "."): content for name, content in entries.items()}
    policy.write_bytes(stored(read_entries(policy, LIMIT) | given))
    return policy
