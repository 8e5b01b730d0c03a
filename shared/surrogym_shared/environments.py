"""Names of original environments, such as ``Pendulum-v1`` or ``package.module:Class``."""

from __future__ import annotations

import re
from pathlib import PurePath

GYMNASIUM_ID = re.compile(r"(?:[A-Za-z_][\w.]*:)?[\w./-]+-v\d+")  # package:Id-v0 is Gymnasium's own spelling
FILES = (".fmu", ".json")  # endings of names that are files


def is_name(text: str) -> bool:
    """Whether a text may open an environment. Others are free text, such as "two tanks"."""
    return ":" in text or GYMNASIUM_ID.fullmatch(text) is not None


def is_same(name: str, other: str) -> bool:
    """Whether two names mean the same environment. A file may lie in another folder on another machine."""
    (kind, _, file), (other_kind, _, other_file) = name.partition(":"), other.partition(":")
    paths = PurePath(file), PurePath(other_file)
    by_file = kind == other_kind and all(path.suffix in FILES for path in paths)
    return name == other or (by_file and paths[0].name == paths[1].name)
