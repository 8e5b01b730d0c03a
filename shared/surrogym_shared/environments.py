"""Names of original environments, such as ``Pendulum-v1`` or ``package.module:Class``."""

from __future__ import annotations

import re
from pathlib import PurePath

# Also matches package:Id-v0, Gymnasium's form with a module to import.
GYMNASIUM_ID = re.compile(r"(?:[A-Za-z_][\w.]*:)?[\w./-]+-v\d+")
FILES = (".fmu", ".json")  # suffixes of names that refer to a file of the original environment


def is_name(text: str) -> bool:
    """Whether a text has the form of an environment's name. Other texts, such as "two tanks", only describe one."""
    return ":" in text or GYMNASIUM_ID.fullmatch(text) is not None


def is_same(name: str, other: str) -> bool:
    """Whether two names refer to the same environment. Files are compared by name only, because their folder may differ
    between machines."""
    (kind, _, file), (other_kind, _, other_file) = name.partition(":"), other.partition(":")
    paths = PurePath(file), PurePath(other_file)
    by_file = kind == other_kind and all(path.suffix in FILES for path in paths)
    return name == other or (by_file and paths[0].name == paths[1].name)


def is_elsewhere(name: str | None, own: str) -> bool:
    """Whether a name refers to another environment than ``own``, the environment of a specification. False if the name
    is None, or if the specification only describes its environment."""
    return name is not None and is_name(own) and not is_same(name, own)
