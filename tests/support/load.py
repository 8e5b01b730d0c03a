"""Trainings that follow one another and samplers of designs that follow one another, while something is killed."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from itertools import count
from pathlib import Path

from support.disturbed import LANES, SMALL
from support.noting import NotingSamplers, Tally, create, finished, noting_samplers, until
from surrogym_client.transport import Api, HttpSurrogate, Retries
from surrogym_trainer.training import TrainProgress, TrainResult, TrainSettings, train

SAMPLERS, TRAININGS = 4, 3  # that work at once
STEPS = 4_096  # of one training
SECONDS = 900.0  # longest time without progress, and of a request: a cluster is built again meanwhile


class Trainings(threading.Thread):
    """Trainings with PPO, one after another. The last one runs to its end after ``stop``.

    Args:
        url: of the server.
        folder: of the policies.
        surrogate: returns the name of the surrogate of the next training.
    """

    def __init__(self, url: str, folder: Path, surrogate: Callable[[], str]) -> None:
        super().__init__()
        self.rollouts = 0
        self.results: list[TrainResult] = []
        self.error: BaseException | None = None
        self._url, self._folder, self._surrogate = url, folder, surrogate
        self._ending = threading.Event()

    def run(self) -> None:
        settings = TrainSettings(
            "PPO", total_steps=STEPS, num_envs=LANES, hyperparameters=SMALL, session={"time_limit": 50}
        )
        try:
            for number in count():
                with HttpSurrogate(self._url, self._surrogate(), retries=Retries(SECONDS)) as port:
                    self.results.append(train(port, self._folder / f"{number}.zip", settings, self._note))
                if self._ending.is_set():
                    return
        except BaseException as error:
            self.error = error

    def stop(self) -> None:
        self._ending.set()
        self.join()

    def _note(self, _: TrainProgress) -> None:
        self.rollouts += 1


@dataclass
class Designs:
    """Designs that follow one another, with four samplers each. Each is judged at its end.

    Args:
        api, url: the server, and its address for samplers.
        folder: of the samplers' notes.
        prefix: beginning of the designs' names.
        budget: real steps of each.
    """

    api: Api
    url: str
    folder: Path
    prefix: str
    budget: int
    tally: Tally = field(default_factory=Tally)
    taught: str = "pendulum"  # newest surrogate that has a model
    name: str = ""
    samplers: NotingSamplers | None = None
    _stack: ExitStack = field(default_factory=ExitStack)
    _numbers: Iterator[int] = field(default_factory=count)

    def begin(self) -> None:
        self.name = f"{self.prefix}-{next(self._numbers)}"
        create(self.api, self.name, self.budget)
        self.samplers = self._stack.enter_context(
            noting_samplers(self.url, self.name, self.folder / self.name, count=SAMPLERS, lease_seconds=60.0)
        )

    def acknowledged(self) -> int:
        """Return the number of samples that this design's samplers have got an acknowledgement for."""
        assert self.samplers is not None
        return len(self.samplers.notes().acknowledged)

    def end(self) -> None:
        """Wait until the design ends, and judge it."""
        assert self.samplers is not None
        samplers = self.samplers
        assert until(lambda: finished(self.api, self.name), SECONDS), f"it ends, but is {self.api.surrogate(self.name)}"
        assert until(lambda: not samplers.in_a_step(), SECONDS), "whoever took a step hands it in"
        self.tally.judge(self.api, self.name, samplers.notes(), patient=True)
        self._stack.close()
        self.taught = self.name


@dataclass
class Load:
    """What runs while something is killed."""

    designs: Designs
    trainings: list[Trainings]

    def progress(self) -> None:
        """Wait until each training has had a rollout and a sample was acknowledged, or raise what ended a training."""
        before, samples = [one.rollouts for one in self.trainings], self.designs.acknowledged()
        deadline = time.monotonic() + SECONDS
        while self._stands(before, samples):
            for one in self.trainings:
                if one.error is not None:
                    raise one.error
            assert time.monotonic() < deadline, (before, samples, [one.rollouts for one in self.trainings])
            if finished(self.designs.api, self.designs.name):
                self.designs.end()
                self.designs.begin()
                samples = 0
            time.sleep(0.05)

    def _stands(self, rollouts: list[int], samples: int) -> bool:
        trained = all(one.rollouts > before for one, before in zip(self.trainings, rollouts, strict=True))
        return not (trained and self.designs.acknowledged() > samples)

    @property
    def results(self) -> list[TrainResult]:
        return [result for one in self.trainings for result in one.results]


@contextmanager
def load(api: Api, url: str, folder: Path, prefix: str, budget: int) -> Iterator[Load]:
    """Four samplers, a training of the surrogate ``pendulum``, and two of the newest design that has ended."""
    designs = Designs(api, url, folder, prefix, budget)
    trainings = [Trainings(url, folder / "settled", lambda: "pendulum")]
    trainings += [Trainings(url, folder / f"newest-{n}", lambda: designs.taught) for n in range(1, TRAININGS)]
    designs.begin()
    for one in trainings:
        one.start()
    try:
        yield Load(designs, trainings)
        designs.end()
    finally:
        for one in trainings:
            one.stop()
        designs._stack.close()
    for one in trainings:
        if one.error is not None:
            raise one.error
