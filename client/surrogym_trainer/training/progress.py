"""The progress of a training for a progress bar: a share that never falls, and the time left."""

from __future__ import annotations

from dataclasses import replace

from surrogym_trainer.training.settings import TrainProgress


class ProgressEstimate:
    """The share of a training that is done.

    A training may be extended: by a round, after an audit, or because it still gains. The part that is not done then
    stands for all steps that are left, so that the share never falls.
    """

    def __init__(self) -> None:
        # share of the training that is done: now, and when the total number of steps last changed
        self._share = self._base = 0.0
        self._steps = self._begun = 0  # virtual steps taken: now, and when the total number of steps last changed
        self._total = 0
        # virtual steps and seconds at the first call of words_of_time_left
        self._first: tuple[int, float] | None = None

    def share(self, steps: int, total: int) -> float:
        """Return the share that is done, in [0, 1], after ``steps`` of ``total`` virtual steps."""
        if total != self._total:
            self._begun, self._base, self._total = self._steps, self._share, total
        self._steps = max(self._steps, steps)
        left = max(total - self._begun, 1)
        done = self._base + (1 - self._base) * min((self._steps - self._begun) / left, 1.0)
        self._share = max(self._share, done)
        return self._share

    def words_of_time_left(self, steps: int, total: int, seconds: float) -> str:
        """Return in words an estimate of how long a training of ``total`` virtual steps still takes.

        The pace is measured since the first call, because work before the first steps, such as compiling, happens only
        once. So the first call gives no estimate, which is an empty text.

        Args:
            steps: virtual steps taken.
            total: virtual steps of the whole training, as far as is known.
            seconds: duration so far.
        """
        before, began = self._first = self._first or (steps, seconds)
        if steps <= before or seconds <= began or steps >= total:
            return ""
        left = (total - steps) * (seconds - began) / (steps - before)
        return f", about {f'{left:.0f} s' if left < 90 else f'{left / 60:.0f} min'} left"


def after(now: TrainProgress, done: int, total: int = 0) -> TrainProgress:
    """Return the progress ``now`` of a training, with the ``done`` virtual steps of earlier trainings added to its
    steps and to its total. The total is at least ``total``."""
    return replace(now, steps=done + now.steps, total_steps=max(total, done + now.total_steps))
