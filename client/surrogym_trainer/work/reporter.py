"""Reports of a running job: how far it is, that its worker lives, and whether it is to stop."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from types import TracebackType
from typing import Self

from surrogym_client.errors import ServerUnreachable, SurrogymClientError, Unavailable
from surrogym_client.transport.api import Api
from surrogym_client.transport.connection import Retries
from surrogym_shared import wire
from surrogym_trainer.policies.pushing import thinned
from surrogym_trainer.training import TrainProgress
from surrogym_trainer.training.course import Course

AWAY = (ServerUnreachable, Unavailable)
ONE_ATTEMPT = Retries(seconds=0)  # the next report repeats it
REPORT_SECONDS = 1.0  # between two reports of a job that goes on; people see them a moment later


@dataclass(frozen=True)
class Stand:
    """How far a job is, as the worker knows it."""

    stage: wire.JobStage = "preparing"
    share: float = 0.0
    now: TrainProgress | None = None
    curve: tuple[wire.CurvePoint, ...] = ()
    course: Course = field(default_factory=Course, compare=False)  # of the training; it goes on from stand to stand

    def trained(self, now: TrainProgress, seconds: float) -> Stand:
        """Add the progress of a training."""
        point = wire.CurvePoint(steps=now.steps, imagined_return=finite(now.imagined_return), seconds=seconds)
        share = self.course.share(now.steps, now.total_steps)
        return replace(self, stage="training", share=share, now=now, curve=(*self.curve, point))

    def as_sent(self) -> wire.JobState:
        """Return the form that the server stores."""
        now = self.now
        return wire.JobState(
            stage=self.stage,
            share=min(max(self.share, 0.0), 1.0),
            steps=None if now is None else now.steps,
            total_steps=None if now is None else now.total_steps,
            imagined_return=None if now is None else finite(now.imagined_return),
            curve=[
                wire.JobPoint(steps=point.steps, imagined_return=point.imagined_return) for point in thinned(self.curve)
            ],
        )


def finite(value: float | None) -> float | None:
    """Return a number that JSON can hold, and None for any other."""
    return value if value is not None and math.isfinite(value) and abs(value) <= wire.MAX_MEASURED else None


class JobStopped(KeyboardInterrupt):
    """A person cancelled the job, or another worker has it. Searches and evaluations end as after Ctrl-C."""


@dataclass
class Reporter:
    """Reports one job from a thread, each second or as often as its lease needs.

    A server that is away is tried again by the next report, and the job goes on.

    Attributes:
        api: the server.
        surrogate: name of the surrogate.
        job: the job.
        show: called with each new stand.
    """

    api: Api
    surrogate: str
    job: wire.LeasedJob
    show: Callable[[Stand], None] = lambda _: None
    stand: Stand = field(default_factory=Stand, init=False)
    cancelled: bool = field(default=False, init=False)  # a person asked for it
    taken: bool = field(default=False, init=False)  # the job has ended, or another worker has it

    def __post_init__(self) -> None:
        self._started = time.monotonic()
        self._ending = threading.Event()
        self._reported: Stand | None = None
        self._thread = threading.Thread(target=self._beat, name="reporter", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._ending.set()
        self._thread.join(timeout=5.0)

    def trained(self, now: TrainProgress) -> None:
        """Note the progress of a training. Raises ``JobStopped`` if it is to end."""
        self._note(self.stand.trained(now, round(time.monotonic() - self._started, 3)))

    def at(self, stage: wire.JobStage, share: float = 0.0) -> None:
        """Note that a stage has come so far. Raises ``JobStopped`` if it is to end."""
        self._note(replace(self.stand, stage=stage, share=share))

    def storing(self) -> None:
        """Report at once that the result is being sent, which nothing stops, with the end of the curve."""
        self.stand = replace(self.stand, stage="storing", share=0.0)
        self.show(self.stand)
        self._report(self.stand)

    def _note(self, stand: Stand) -> None:
        self.stand = stand
        self.show(stand)
        if self.cancelled or self.taken:
            raise JobStopped

    def _beat(self) -> None:
        silent = 0.0
        while not self._ending.wait(min(REPORT_SECONDS, self.job.lease_seconds / 3)):
            silent += REPORT_SECONDS
            stand = self.stand
            if stand is not self._reported or silent >= self.job.lease_seconds / 3:
                self._report(stand)
                silent = 0.0

    def _report(self, stand: Stand) -> None:
        job, seconds = self.job, self.job.lease_seconds
        state = None if stand is self._reported else stand.as_sent()
        try:
            asked = self.api.jobs.report(
                self.surrogate, job.id, job.lease_token, state=state, lease_seconds=seconds, retries=ONE_ATTEMPT
            )
            self.cancelled = self.cancelled or asked
            self._reported = stand
        except AWAY:
            return
        except SurrogymClientError:
            self.taken = True
