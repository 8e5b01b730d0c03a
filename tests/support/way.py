"""Which files of this program an action passes on its way to the model: those whose functions hold it."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
import torch

ROOTS = tuple(str(Path(__file__).parents[2] / part) for part in ("server/surrogym_server", "shared/surrogym_shared"))
DEEPEST = 5
NOT_ON_THE_WAY = ("surrogym_server.models", "surrogym_server.services", "surrogym_server.storage")


class Way:
    """What a profiler sees of one action, known by its value.

    Attributes:
        files: that held it, in order.
        down: the files on the stack at the last call of ``model`` that held it, top first, neighbours joined.
    """

    def __init__(self, action: float, model: str) -> None:
        self._action = action
        self._bytes = np.float64(action).tobytes(), str(action).encode()
        self._model = model
        self.files: list[str] = []
        self.down: list[str] = []

    @contextmanager
    def watched(self) -> Iterator[None]:
        """Of this thread."""
        sys.setprofile(self)
        try:
            yield
        finally:
            sys.setprofile(None)

    def __call__(self, frame: FrameType, event: str, _: Any) -> None:
        if event not in ("call", "return") or (file := _ours(frame)) is None:
            return
        sys.setprofile(None)
        try:
            if any(self._held(value) for value in list(frame.f_locals.values())):
                if file not in self.files:
                    self.files.append(file)
                if event == "call" and file.endswith(self._model):
                    self.down = _stack(frame)
        finally:
            sys.setprofile(self)

    def _held(self, value: Any, depth: int = 0) -> bool:
        match value:
            case np.ndarray():
                return value.dtype.kind == "f" and bool((value == self._action).any())
            case torch.Tensor():
                return value.is_floating_point() and bool((value == self._action).any())
            case bytes() | memoryview():
                content = bytes(value)
                return any(part in content for part in self._bytes)
            case float():
                return value == self._action
        return depth < DEEPEST and any(self._held(part, depth + 1) for part in _parts(value))


def _parts(value: Any) -> list[Any]:
    if isinstance(value, list | tuple):
        return list(value)
    if isinstance(value, dict):
        return list(value.values())
    if hasattr(value, "func") and hasattr(value, "args"):  # functools.partial
        return list(value.args)
    if getattr(value, "__closure__", None):
        return [cell.cell_contents for cell in value.__closure__]
    kind = type(value)
    if not kind.__module__.startswith("surrogym") or kind.__module__.startswith(NOT_ON_THE_WAY):
        return []
    names = getattr(kind, "__struct_fields__", None) or getattr(kind, "__slots__", ())
    return [*getattr(value, "__dict__", {}).values(), *(getattr(value, name, None) for name in names)]


def _ours(frame: FrameType) -> str | None:
    path = frame.f_code.co_filename
    root = next((root for root in ROOTS if path.startswith(root)), None)
    return None if root is None else path[len(root) - len(Path(root).name) :]


def _stack(frame: FrameType | None) -> list[str]:
    files: list[str] = []
    while frame is not None:
        file = _ours(frame)
        if file is not None and (not files or files[-1] != file):
            files.append(file)
        frame = frame.f_back
    return files[::-1]
