"""A sampler in a process of its own that notes each real step before it takes it, and each acknowledgement after it
came: a kill takes no note back."""

from __future__ import annotations

import itertools
import json
import multiprocessing
import os
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from surrogym_client.transport import Api
from surrogym_sampler.original.classic import pendulum
from surrogym_sampler.original.gymnasium import GymnasiumEnvironment
from surrogym_sampler.original.protocol import Array, RealStep
from surrogym_sampler.queries import Sampler, SamplerSettings
from surrogym_shared import wire

STEP_SECONDS = 0.1
PATIENCE_SECONDS = 180.0
LONGEST_LOOK_SECONDS = 0.2

Point = tuple[float, ...]


@dataclass(frozen=True)
class Notes:
    """What samplers noted. A note is a line, written by one call."""

    begun: list[Point]  # coordinates of real steps: each was taken, or its sampler killed in it
    acknowledged: dict[int, Point]  # coordinates, action and reward by the sample's id


@dataclass
class Tally:
    """What many runs came to; each is judged when it is over."""

    kills: int = 0
    begun: int = 0
    stored: int = 0
    unresolved: int = 0
    set_aside: int = 0

    def judge(self, api: Api, name: str, notes: Notes, *, patient: bool) -> None:
        """Hold a surrogate against the notes; ``patient``: no sampler was killed, so that each got its answer."""
        queries, ledger = api.queries(name), api.surrogate(name).ledger
        set_aside = [query for query in queries if query.status == "set_aside"]
        assert {query.status for query in queries} <= {"answered", "set_aside"}, "no query is lost"
        assert all(query.error for query in set_aside)
        samples = list(api.samples(name))
        stored = {sample.id: (*sample.coordinates, *sample.action, sample.reward) for sample in samples}
        answered = {query.id for query in queries if query.status == "answered"}
        assert answered <= {sample.query_id for sample in samples}, "an answer is a sample"
        assert notes.acknowledged.items() <= stored.items(), "all is there, as acknowledged"
        assert len({(sample.query_id, sample.attempt) for sample in samples}) == len(samples), "none is there twice"
        assert ledger.total == len(stored)
        asked = Counter(tuple(sample.requested_coordinates or ()) for sample in samples)
        assert asked <= Counter(notes.begun), "none was made up"
        assert len(notes.begun) <= ledger.total + ledger.unresolved, "none is hidden"
        if patient:
            assert ledger.total == len(notes.acknowledged)
        self.begun += len(notes.begun)
        self.stored += len(stored)
        self.unresolved += ledger.unresolved
        self.set_aside += len(set_aside)

    def __str__(self) -> str:
        return (
            f"{self.kills} kills: {self.begun} real steps begun, {self.stored} acknowledged in the ledger, at most "
            f"{self.unresolved} unresolved; {self.set_aside} queries set aside"
        )


def create(api: Api, name: str, budget: int) -> None:
    """A design that goes on to its budget: its tolerances are such that no model of so few samples reaches them."""
    spec = pendulum()
    design = spec.design.model_copy(update={"initial": 6, "budget": budget, "monte_carlo": 64})
    tolerances = dict.fromkeys(("theta", "speed", "reward"), 1e-9)
    api.create_surrogate(name, spec.model_copy(update={"design": design, "tolerances": tolerances}))


def finished(api: Api, name: str) -> bool:
    view = api.surrogate(name)
    return view.phase in ("ready", "over_budget", "unsure") and not view.queries.pending + view.queries.leased


def until(holds: Callable[[], object], seconds: float = PATIENCE_SECONDS) -> bool:
    """Whether it holds before the time is over. Looks are ever rarer: a server that answers them has a core less for
    what is waited for."""
    started = time.monotonic()
    while (waited := time.monotonic() - started) < seconds:
        if holds():
            return True
        time.sleep(min(LONGEST_LOOK_SECONDS, max(0.005, waited / 10)))
    return False


class Noting(GymnasiumEnvironment):
    """Pendulum, a little slower."""

    def __init__(self, notes: int) -> None:
        super().__init__(pendulum())
        self._notes = notes

    def step_from(self, coordinates: Array, action: Array) -> RealStep:
        _note(self._notes, begun=coordinates.tolist())
        time.sleep(STEP_SECONDS)
        return super().step_from(coordinates, action)


class Acknowledging(Api):
    """Notes what was acknowledged."""

    def __init__(self, url: str, notes: int) -> None:
        super().__init__(url)
        self._notes = notes

    def add_samples(
        self, name: str, sampler: str, samples: Sequence[wire.NewSample], *, idempotency_key: str | None = None
    ) -> wire.AddedSamples:
        added = super().add_samples(name, sampler, samples, idempotency_key=idempotency_key)
        for id, sample in zip(added.sample_ids, samples, strict=True):
            _note(self._notes, id=id, sample=[*sample.coordinates, *sample.action, sample.reward])
        return added


class NotingSamplers:
    """Processes that sample one surrogate; each notes into a file of its own."""

    def __init__(self, url: str, name: str, folder: Path, count: int, lease_seconds: float, batch: int) -> None:
        self._args = (url, name, lease_seconds, batch)
        self._folder = folder
        self._numbers = itertools.count()
        self.working: dict[Path, Any] = {}
        for _ in range(count):
            self.start()

    def start(self) -> None:
        """One more."""
        path = self._folder / f"notes-{next(self._numbers)}"
        path.touch()
        process = multiprocessing.get_context("spawn").Process(target=work, args=(*self._args, str(path)), daemon=True)
        process.start()
        self.working[path] = process

    def in_a_step(self) -> list[Path]:
        """Those that have begun a step which is not acknowledged yet: they hold a lease."""
        noted = {path: self.notes_in(path) for path in self.working}
        return [path for path, notes in noted.items() if len(notes.begun) > len(notes.acknowledged)]

    def signal(self, path: Path, number: int) -> None:
        os.kill(self.working[path].pid, number)

    def kill(self, path: Path) -> None:
        """-9."""
        process = self.working.pop(path)
        process.kill()
        process.join()

    def replace_all(self) -> None:
        """Kill them all, and start as many."""
        for path in list(self.working):
            self.kill(path)
            self.start()

    def notes(self) -> Notes:
        return self.notes_in(*self._folder.glob("notes-*"))

    def notes_in(self, *paths: Path) -> Notes:
        """Those of some samplers."""
        lines = [json.loads(line) for path in paths for line in path.read_text().rpartition("\n")[0].splitlines()]
        return Notes(
            [tuple(line["begun"]) for line in lines if "begun" in line],
            {line["id"]: tuple(line["sample"]) for line in lines if "id" in line},
        )


@contextmanager
def noting_samplers(
    url: str, name: str, folder: Path, *, count: int, lease_seconds: float, batch: int = 2
) -> Iterator[NotingSamplers]:
    """Samplers until the end of the context; what they hold then is left to time out."""
    folder.mkdir()
    samplers = NotingSamplers(url, name, folder, count, lease_seconds, batch)
    try:
        yield samplers
    finally:
        for path in list(samplers.working):
            samplers.kill(path)


def work(url: str, name: str, lease_seconds: float, batch: int, path: str) -> None:
    """Sample until killed."""
    notes = os.open(path, os.O_WRONLY | os.O_APPEND)
    with Acknowledging(url, notes) as api:
        settings = SamplerSettings(batch=batch, wait_seconds=0.5, lease_seconds=lease_seconds)
        Sampler(api, name, Noting(notes), settings).run()


def _note(notes: int, **what: Any) -> None:
    os.write(notes, json.dumps(what).encode() + b"\n")
