"""Ending with the process that started this one, so that a killed parent leaves nothing behind."""

from __future__ import annotations

import os
import threading
import time

LOOK_SECONDS = 0.5
ORPHANED = 1


def exit_with_parent() -> None:
    """Watch the parent from a thread; when it is gone, end this process at once."""
    parent = os.getppid()
    threading.Thread(target=_watch, args=(parent,), name="exit-with-parent", daemon=True).start()


def _watch(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(LOOK_SECONDS)
    os._exit(ORPHANED)
