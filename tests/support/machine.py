"""A machine of which there is one: it notes what is done to it, and whether two drivers ever held it at once."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from support.moody import Line
from support.rail import Rail

STEP_SECONDS = "MACHINE_STEP_SECONDS"  # environment variable: how long a deliberate machine takes
DIARY = "MACHINE_DIARY"  # environment variable: the file that everything is noted in, also by other processes


def note(what: str) -> None:
    with Path(os.environ[DIARY]).open("a") as diary:
        diary.write(what + "\n")


class Machine(Rail):
    """Can be reset and acted on; every instance is a driver."""

    def __init__(self):
        super().__init__()
        note("open")

    def reset(self, *, seed=None):
        note(f"reset {seed}")
        return super().reset(seed=seed)

    def step(self, action):
        note(f"step {float(action[0]):g}")
        return super().step(action)

    def close(self):
        note("close")


class SettableMachine(Line):
    """Can be set to any state; every instance is a driver."""

    def __init__(self):
        note("open")

    def step_from(self, coordinates, action):
        note(f"step {float(action[0]):g}")
        return super().step_from(coordinates, action)

    def close(self):
        note("close")


class Deliberate(SettableMachine):
    """Takes its time, for a step and to close."""

    def step_from(self, coordinates, action):
        taken = super().step_from(coordinates, action)
        time.sleep(float(os.environ.get(STEP_SECONDS, "1")))
        note("done")
        return taken

    def close(self):
        super().close()
        time.sleep(0.5)
        note("closed")


class Simulator(Machine):
    """The same, of which several may run at once."""

    parallel = True


def most_at_once(diary: list[str]) -> int:
    """How many drivers held it at the same time."""
    held = most = 0
    for what in diary:
        held += {"open": 1, "close": -1}.get(what, 0)
        most = max(most, held)
    assert held == 0, "every driver lets go"
    return most


@contextmanager
def diary_in(folder: Path, monkeypatch) -> Iterator[Path]:
    """Where machines note, as long as the context lasts."""
    path = folder / "diary"
    path.touch()
    with monkeypatch.context() as patch:
        patch.setenv(DIARY, str(path))
        yield path
