"""Videos show the best, the median and the worst episode, take no real step, and are small."""

from __future__ import annotations

import io
import sys

import numpy as np
import pytest
from PIL import Image

from surrogym_client.environments.pictures import NotRenderable
from surrogym_sampler.original.classic import cartpole
from surrogym_sampler.original.rendering import renderer_of
from surrogym_trainer.evaluation import videos
from surrogym_trainer.evaluation.evaluator import Evaluation, Trace

SPEC = cartpole()


def episodes(*lengths: int) -> Evaluation:
    """CartPole's cart moves to the right, and to the left in odd episodes."""
    traces = []
    for number, length in enumerate(lengths):
        states = np.zeros((length + 1, 4))
        states[:, 0] = np.linspace(0, (-1) ** number, length + 1)
        traces.append(Trace(states, np.zeros((length, 1)), np.ones(length)))
    returns = np.array(lengths, dtype=np.float64)
    return Evaluation(returns, np.array(lengths), None, tuple(traces))


def test_an_evaluation_video_shows_episodes_side_by_side_and_holds_ended_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    video = videos.record(SPEC, None, episodes(20, 40, 10), "declared starts")
    assert video.form == "gif"
    with Image.open(io.BytesIO(video.content)) as picture:
        assert picture.width == 3 * videos.PANEL
        assert 40 // 5 <= picture.n_frames <= 40 // 5 + 2  # CartPole has 50 steps a second, the GIF 10 frames
        assert "loop" not in picture.info  # plays once
        picture.seek(picture.n_frames - 1)
        last = np.asarray(picture.convert("RGB"), dtype=np.float64)
    assert [nearest(last, place) for place in range(3)] == [-1.0, 1.0, 1.0]  # 40 steps, 20, 10: each at its end


def nearest(frame: np.ndarray, place: int) -> float:
    """Which end of the cart's way the panel shows."""
    panel = frame[videos.LINE : -videos.LINE, place * videos.PANEL : (place + 1) * videos.PANEL]
    renderer = renderer_of(SPEC)
    drawn = {x: np.asarray(videos._scaled(renderer.draw(np.array([x, 0.0, 0.0, 0.0])))) for x in (-1.0, 0.0, 1.0)}
    renderer.close()
    return min(drawn, key=lambda x: float(np.abs(panel - drawn[x].astype(np.float64)).mean()))


def test_evaluation_videos_are_mp4_if_ffmpeg_is_installed_and_limited_in_length(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    pytest.importorskip("imageio_ffmpeg")
    monkeypatch.setattr(videos, "MOST_FRAMES", 30)
    video = videos.record(SPEC, None, episodes(200), "declared starts")
    assert video.form == "mp4"
    assert video.content[4:8] == b"ftyp"
    assert len(video.content) < 100_000


def test_the_error_for_an_evaluation_video_that_cannot_be_drawn_gives_the_reason() -> None:
    with pytest.raises(NotRenderable, match="expected original="):
        videos.record(SPEC.model_copy(update={"environment": "my plant"}), None, episodes(3), "")
