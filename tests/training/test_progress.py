"""The bar of a training: it never goes back, whatever extends the training, and ends full."""

from __future__ import annotations

import pytest

from surrogym_trainer.training import TrainProgress
from surrogym_trainer.training.settings import ProgressEstimate, after

REPORTED = [  # of a demo, whose bar went back twice
    *((steps, 442_368) for steps in (8_192, 217_088, 434_176)),
    *((steps, 884_736) for steps in (442_368, 630_784, 884_736)),
    *((steps, 1_327_104) for steps in (892_928, 1_064_960, 1_327_104)),
]


def test_the_training_progress_never_falls_when_the_training_is_extended():
    estimate = ProgressEstimate()
    shares = [estimate.share(*reported) for reported in REPORTED]
    assert shares == sorted(shares)
    assert shares[0] == pytest.approx(8_192 / 442_368)
    assert shares[-1] == pytest.approx(1.0)


def test_the_progress_of_a_training_without_extension_is_its_share_of_steps_done():
    estimate = ProgressEstimate()
    assert [estimate.share(steps, 400) for steps in (100, 200, 400)] == [0.25, 0.5, 1.0]


def test_the_step_count_of_a_following_training_continues_the_first():
    now = after(TrainProgress(50, 200, None, 0.0), done=1_000)
    assert (now.steps, now.total_steps) == (1_050, 1_200)
    assert after(TrainProgress(50, 200, None, 0.0), done=1_000, total=5_000).total_steps == 5_000


def test_the_estimated_remaining_time_follows_the_steps_per_second():
    """The first estimate was far too long: it took the time of compiling for that of the first steps."""
    estimate, compiling = ProgressEstimate(), 60.0
    assert estimate.words_of_time_left(100, 1_000, compiling + 1.0) == "", "no pace is known yet"
    assert estimate.words_of_time_left(200, 1_000, compiling + 2.0) == "about 8 s left, "
    assert estimate.words_of_time_left(200, 100_000, compiling + 2.0) == "about 17 min left, "
    assert estimate.words_of_time_left(1_000, 1_000, compiling + 10.0) == ""


def test_no_remaining_time_is_estimated_before_the_first_step():
    estimate = ProgressEstimate()
    assert estimate.words_of_time_left(0, 400, 10.0) == estimate.words_of_time_left(0, 400, 20.0) == ""
    assert estimate.words_of_time_left(100, 400, 30.0) == "about 60 s left, "
