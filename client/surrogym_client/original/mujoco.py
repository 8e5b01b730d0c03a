from __future__ import annotations
from typing import Any

SPECIFICATIONS: dict[str, Any] = {}


def is_known(name: str) -> bool:
    return False
