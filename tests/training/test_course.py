"""The bar of a training: it never goes back, whatever extends the training, and ends full."""

from __future__ import annotations

import pytest

from surrogym_trainer.training import TrainProgress
from surrogym_trainer.training.course import Course, after, words_of_time_left

REPORTED = [  # of a demo, whose bar went back twice
    *((steps, 442_368) for steps in (8_192, 217_088, 434_176)),
    *((steps, 884_736) for steps in (442_368, 630_784, 884_736)),
    *((steps, 1_327_104) for steps in (892_928, 1_064_960, 1_327_104)),
]


def test_the_share_never_falls_when_a_training_is_extended():
    course = Course()
    shares = [course.share(*reported) for reported in REPORTED]
    assert shares == sorted(shares)
    assert shares[0] == pytest.approx(8_192 / 442_368)
    assert shares[-1] == pytest.approx(1.0)


def test_the_share_of_a_training_that_is_not_extended_is_that_of_its_steps():
    course = Course()
    assert [course.share(steps, 400) for steps in (100, 200, 400)] == [0.25, 0.5, 1.0]


def test_a_training_after_another_continues_its_steps():
    now = after(TrainProgress(50, 200, None, 0.0), done=1_000)
    assert (now.steps, now.total_steps) == (1_050, 1_200)
    assert after(TrainProgress(50, 200, None, 0.0), done=1_000, total=5_000).total_steps == 5_000


def test_the_time_left_follows_from_the_pace_so_far():
    assert words_of_time_left(100, 400, 10.0) == ", about 30 s left"
    assert words_of_time_left(100, 4_000, 10.0) == ", about 6 min left"
    assert words_of_time_left(0, 400, 10.0) == words_of_time_left(400, 400, 10.0) == ""
