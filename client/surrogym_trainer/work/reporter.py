"""Reports of a running job to the server: its progress, that its worker is alive, and whether it has to stop."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from types import TracebackType
from typing import Self

from surrogym_client.errors import SurrogymClientError
from surrogym_client.transport.api import Api
from surrogym_client.transport.connection import AWAY, ONE_ATTEMPT
from surrogym_shared import wire
from surrogym_trainer.policies.pushing import thinned
from surrogym_trainer.training import TrainProgress
from surrogym_trainer.training.settings import ProgressEstimate

REPORT_SECONDS = 1.0  # seconds between two reports of a running job


@dataclass(frozen=True)
class Stand:
    """The progress of a job, as the worker knows it."""

    stage: wire.JobStage = "preparing"
    share: float = 0.0
    now: TrainProgress | None = None
    curve: tuple[wire.CurvePoint, ...] = ()
    # Estimate of the share of the training that is done, which never falls. Successive records of one job share this
    # object.
    estimate: ProgressEstimate = field(default_factory=ProgressEstimate, compare=False)

    def trained(self, now: TrainProgress, seconds: float) -> Stand:
        """Return the progress after a report of the training, ``seconds`` after the job's start."""
        point = wire.CurvePoint(steps=now.steps, imagined_return=finite(now.imagined_return), seconds=seconds)
        share = self.estimate.share(now.steps, now.total_steps)
        return replace(self, stage="training", share=share, now=now, curve=(*self.curve, point))

    def as_sent(self) -> wire.JobState:
        """Return the progress in the form that the server stores."""
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
    """Return a number if JSON and the server can store it, else None."""
    return value if value is not None and math.isfinite(value) and abs(value) <= wire.MAX_MEASURED else None


class JobStopped(KeyboardInterrupt):
    """A person cancelled the job, or another worker has it. Searches and evaluations then end as after Ctrl-C."""


@dataclass
class Reporter:
    """Reports the progress of one job to the server from a thread: each second, or as often as is needed to keep the
    job reserved for this worker.

    If the server can't be reached, the next report tries again, and the job continues.

    Attributes:
        api: the connection to the server.
        surrogate: name of the surrogate.
        job: the job.
        show: called with the progress each time it changes.
    """

    api: Api
    surrogate: str
    job: wire.LeasedJob
    show: Callable[[Stand], None] = lambda _: None
    stand: Stand = field(default_factory=Stand, init=False)
    cancelled: bool = field(default=False, init=False)  # whether a person cancelled the job
    taken: bool = field(default=False, init=False)  # whether the job has ended on the server, or another worker has it

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
        """Record the progress of a training. Raises ``JobStopped`` if the job has to stop."""
        self._note(self.stand.trained(now, round(time.monotonic() - self._started, 3)))

    def at(self, stage: wire.JobStage, share: float = 0.0) -> None:
        """Record the share of a stage that is done. Raises ``JobStopped`` if the job has to stop."""
        self._note(replace(self.stand, stage=stage, share=share))

    def storing(self) -> None:
        """Report at once that the result is being sent, together with the end of the training curve. From then on the
        job can't be stopped."""
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
