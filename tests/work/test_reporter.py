"""Reports of a job: the curve goes on over several trainings, and a job that is lost or cancelled stops."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import pytest

from surrogym_client.errors import LeaseExpired, ServerUnreachable
from surrogym_shared import wire
from surrogym_shared.codes import Code, Problem
from surrogym_trainer.training import TrainProgress
from surrogym_trainer.work.reporter import JobStopped, Reporter, Stand

JOB = wire.LeasedJob(id=1, attempt=1, lease_token="a", lease_seconds=0.03, task=wire.TrainTask(kind="train"))
ENDED = LeaseExpired(Problem(title="ended", status=409, code=Code.LEASE_EXPIRED, detail="another worker has it"))


class Jobs:
    """A server's jobs: answers a report as it is told to."""

    def __init__(self, answers: list[bool | Exception]) -> None:
        self.answers, self.states = answers, list[Any]()

    @property
    def jobs(self) -> Jobs:
        return self

    def report(self, *_: object, state: wire.JobState | None, **__: object) -> bool:
        self.states.append(state)
        answer = self.answers.pop(0) if len(self.answers) > 1 else self.answers[0]
        if isinstance(answer, Exception):
            raise answer
        return answer


def progress(steps: int, imagined: float | None = -1.0) -> TrainProgress:
    return TrainProgress(steps, 10, imagined, 0.0)


def test_the_reported_curve_of_an_extended_training_continues():
    stand, shares = Stand(), [0.0]
    for steps, total in ((4, 10), (8, 10), (11, 18), (14, 18)):
        stand = stand.trained(TrainProgress(steps, total, -1.0, 0.0), 1.0)
        shares.append(stand.share)
    sent = stand.as_sent()
    assert [point.steps for point in sent.curve] == [4, 8, 11, 14]
    assert (sent.steps, sent.total_steps) == (14, 18)
    assert shares == sorted(shares)
    assert sent.share == pytest.approx(0.8 + 0.2 * 6 / 10)


def test_a_reported_learning_curve_is_thinned_and_leaves_out_nan_returns():
    stand = Stand()
    for steps in range(1, 1_000):
        stand = stand.trained(TrainProgress(steps, 1_000, float("inf"), 0.0), 1.0)
    sent = stand.as_sent()
    assert len(sent.curve) <= wire.MAX_JOB_POINTS
    assert (sent.curve[-1].steps, sent.curve[-1].imagined_return, sent.imagined_return) == (999, None, None)


@pytest.mark.parametrize(("answer", "taken"), [(True, False), (ENDED, True)])
def test_a_cancelled_or_lost_job_stops_at_its_next_progress_report(answer: bool | Exception, taken: bool):
    with Reporter(Jobs([answer]), "pendulum", JOB) as reporter:
        with pytest.raises(JobStopped):
            work_on(reporter.trained)
        assert (reporter.cancelled, reporter.taken) == (not taken, taken)


def test_the_end_of_a_short_training_is_reported_before_its_result():
    jobs, slow = Jobs([False]), JOB.model_copy(update={"lease_seconds": 600.0})
    with Reporter(jobs, "pendulum", slow) as reporter:
        reporter.trained(progress(10))
        reporter.storing()
    assert [point.steps for point in jobs.states[-1].curve] == [10]


def test_an_unreachable_server_does_not_stop_a_job_and_gets_reports_later():
    jobs = Jobs([ServerUnreachable("away"), ServerUnreachable("away"), False])
    with Reporter(jobs, "pendulum", JOB) as reporter:
        reporter.trained(progress(1))
        while len(jobs.states) < 4:
            reporter.at("training")
            time.sleep(0.005)  # else its thread hardly gets a turn
    assert (reporter.cancelled, reporter.taken) == (False, False)
    assert [point.steps for point in jobs.states[2].curve] == [1]


def work_on(note: Callable[[TrainProgress], None]) -> None:
    for steps in range(1, 10**9):
        note(progress(min(steps, 10)))
