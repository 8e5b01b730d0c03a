"""Processes that sample a design with snapshots, and note each real step before they take it and after it: a kill takes
no note back."""

from __future__ import annotations

import itertools
import json
import multiprocessing
import os
import tempfile
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from surrogym_client.transport import Api
from surrogym_sampler import original
from surrogym_sampler.original.gymnasium import GymnasiumEnvironment
from surrogym_sampler.original.protocol import Array, RealStep
from surrogym_sampler.queries import Sampler, SamplerSettings
from surrogym_sampler.queries.snapshots import ENDING, Bounds, SnapshotFolder
from surrogym_shared.spec import EnvironmentSpec

STEP_SECONDS = 0.05
LEASE_SECONDS = 2.0
ENDED = ("ready", "over_budget", "unsure")

Step = tuple[float, ...]


@dataclass
class Notes:
    """What samplers noted, a line for each note."""

    begun: int = 0  # real steps
    taken: Counter[Step] = field(
        default_factory=Counter
    )  # coordinates, action and next coordinates of those that ended
    said: list[tuple[str, str]] = field(default_factory=list)  # outcome and error of each query


def create(api: Api, name: str, budget: int) -> None:
    """A design that goes on to its budget: its tolerances are such that no model of so few samples reaches them."""
    spec = saved_pendulum(budget)
    tolerances = dict.fromkeys(("theta", "speed", "reward"), 1e-6)
    api.create_surrogate(name, spec.model_copy(update={"tolerances": tolerances}))


def saved_pendulum(budget: int) -> EnvironmentSpec:
    """A small design."""
    spec = original.make("Pendulum-v1", access="snapshot", budget=budget, initial=6).spec()
    return spec.model_copy(update={"design": spec.design.model_copy(update={"monte_carlo": 64})})


def ended(api: Api, name: str) -> bool:
    view = api.surrogate(name)
    return view.phase in ENDED and not view.queries.pending + view.queries.leased


def require_true(api: Api, name: str, notes: Notes, budget: int) -> None:
    """Hold the server's samples and its ledger against the notes."""
    view, samples = api.surrogate(name), list(api.samples(name))
    stored = Counter((*s.coordinates, *s.action, *s.next_coordinates) for s in samples)
    assert stored <= notes.taken, "each sample is a real step, and none is there twice"
    assert len({(s.query_id, s.attempt, s.step) for s in samples}) == len(samples)
    assert view.ledger.total == len(samples) <= budget
    assert notes.begun <= view.ledger.total + view.ledger.unresolved, "none is hidden"
    assert (view.queries.pending, view.queries.leased) == (0, 0), "no query is lost"


def require_no_dead_snapshots(api: Api, name: str, folder: Path | None) -> None:
    """Hold the server's snapshots against the files. Without a folder, all of them have ended with their samplers."""
    there = [] if folder is None else [path.name.removesuffix(ENDING) for path in (folder / name).glob(f"*{ENDING}")]
    assert {one.name for one in api.snapshots(name)} <= set(there)


class NotingPendulum(GymnasiumEnvironment):
    """Pendulum, a little slower."""

    def __init__(self, notes: int) -> None:
        super().__init__(saved_pendulum(10))
        self._notes = notes

    def act(self, action: Array) -> RealStep:
        _note(self._notes, begun=1)
        time.sleep(STEP_SECONDS)
        step = super().act(action)
        _note(self._notes, taken=[*step.coordinates, *step.action, *step.next_coordinates])  # type: ignore[misc]
        return step


class SavingSamplers:
    """Processes that sample one surrogate until its design has ended; each notes into a file of its own.

    Args:
        snapshots: folder that they share; None: each has its own.
        most: largest number of snapshots.
    """

    def __init__(self, url: str, name: str, notes: Path, snapshots: Path | None, most: int = 1_000) -> None:
        notes.mkdir()
        self._args, self._notes = (url, name, snapshots, most), notes
        self._numbers = itertools.count()

    def start(self) -> Any:
        """One more."""
        path = self._notes / f"notes-{next(self._numbers)}"
        path.touch()
        process = multiprocessing.get_context("spawn").Process(target=work, args=(*self._args, str(path)), daemon=True)
        process.start()
        return process

    def notes(self) -> Notes:
        told = Notes()
        for path in self._notes.iterdir():
            for line in map(json.loads, path.read_text().rpartition("\n")[0].splitlines()):
                told.begun += line.get("begun", 0)
                told.taken.update([tuple(line["taken"])] if "taken" in line else [])
                told.said += [tuple(line["said"])] if "said" in line else []
        return told


def work(url: str, name: str, snapshots: Path | None, most: int, path: str) -> None:
    """Sample until the design has ended."""
    notes = os.open(path, os.O_WRONLY | os.O_APPEND)
    settings = SamplerSettings(
        name=Path(path).name,
        wait_seconds=0.5,
        lease_seconds=LEASE_SECONDS,
        until_done=True,
        snapshots=snapshots,
        bounds=Bounds(count=most),
    )
    tempfile.tempdir = str(Path(path).parent.parent)  # where a kill leaves what nobody removes
    with Api(url) as api:
        Sampler(api, name, NotingPendulum(notes), settings, lambda _, *said: _note(notes, said=said)).run()


def fill(folder: Path, spec: EnvironmentSpec, seed: int) -> None:
    """Keep snapshots in a folder that has room for a few, for as long as another one does the same."""
    rng, kept = np.random.default_rng(seed), SnapshotFolder(folder, spec, Bounds(count=5))
    for number in range(1_000):
        kept.add(bytes(2_000), [float(rng.uniform(-1, 1))])
        if number % 10 == 0:
            SnapshotFolder(folder, spec).names()


def _note(notes: int, **what: Any) -> None:
    os.write(notes, json.dumps(what).encode() + b"\n")
