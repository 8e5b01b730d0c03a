"""Videos of real episodes: the best, the median and the worst side by side, drawn from their recorded states.

No real step is taken for a video. A frame is (height, width, 3) uint8.
"""

from __future__ import annotations

import io
import math
import tempfile
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from surrogym_client.environments.pictures import NotRenderable, Picture, Renderer
from surrogym_sampler.original.rendering import renderer_of
from surrogym_shared.spec import EnvironmentSpec
from surrogym_trainer.evaluation.evaluator import Evaluation, Trace

if TYPE_CHECKING:
    from PIL.Image import Image

Form = Literal["mp4", "gif"]
FORMS: tuple[Form, ...] = ("mp4", "gif")
PANEL = 240  # width of one episode's picture in pixels
LINE, TEXT = 20, 13  # height of a line and of its text in pixels
MOST_FRAMES = 600  # largest number of frames in a video; longer episodes are shown faster
GIF_FRAMES_PER_SECOND = 10  # fewer than in an MP4, because a GIF with all frames would be six times as large
INK, PAPER = (23, 32, 42), (255, 255, 255)


@dataclass(frozen=True)
class Video:
    """A video file: its format, and its content."""

    form: Form
    content: bytes


@dataclass(frozen=True)
class _Panel:
    """One episode of a video, and the heading over it."""

    title: str
    trace: Trace

    def at(self, step: int) -> int:
        """Return the index of the state to draw at a step; after the episode's end it is the last state."""
        return min(step, len(self.trace.coordinates) - 1)


def record(spec: EnvironmentSpec, original: str | None, result: Evaluation, caption: str) -> Video:
    """Make a video of the best, the median and the worst of some real episodes.

    Args:
        spec: specification of the environment.
        original: name of the environment; ``package.module:factory`` needs a method ``picture``.
        result: the episodes.
        caption: a line for the foot of the video, such as the kind of starts.

    Raises:
        NotRenderable: the environment can't be drawn, or a package that a video needs is not installed.
    """
    try:
        import PIL  # noqa: F401
    except ModuleNotFoundError as error:
        raise NotRenderable("a video needs the package pillow: pip install 'surrogym[render]'") from error
    panels = [_Panel(f"{rank}: {result.returns[at]:.4g}", result.traces[at]) for rank, at in result.ranked().items()]
    with closing(renderer_of(spec, original)) as renderer:
        fps = max(1, renderer.frames_per_second)
        try:
            return Video("mp4", _mp4(_frames(renderer, panels, caption, 1), fps))
        except (ImportError, RuntimeError, OSError):  # ffmpeg is missing on this machine, or fails
            every = max(1, round(fps / GIF_FRAMES_PER_SECOND))
            return Video("gif", _gif(_frames(renderer, panels, caption, every), every / fps))


def _frames(renderer: Renderer, panels: list[_Panel], caption: str, every: int) -> Iterator[Image]:
    """Yield frames with all episodes side by side: one frame for each ``every`` steps, or fewer frames in long
    episodes."""
    steps = max(len(panel.trace.coordinates) for panel in panels)
    faster = math.ceil(steps / MOST_FRAMES)
    words = caption if faster == 1 else f"{caption}; one of {faster} steps is shown"
    shown = sorted({*range(0, steps, every * faster), steps - 1})
    for step in shown:
        drawn = [_scaled(renderer.draw(panel.trace.coordinates[panel.at(step)])) for panel in panels]
        yield _composed(drawn, [_heading(panel, step) for panel in panels], words)


def _heading(panel: _Panel, step: int) -> str:
    last = len(panel.trace.coordinates) - 1
    return f"{panel.title}, step {step}" if step < last else f"{panel.title}, end at {last}"


def _scaled(picture: Picture) -> Image:
    from PIL.Image import Resampling, fromarray

    height, width = picture.shape[:2]
    return fromarray(picture).resize((PANEL, max(1, round(PANEL * height / width))), Resampling.LANCZOS)


def _composed(drawn: list[Image], headings: list[str], caption: str) -> Image:
    """Return a frame of pictures with their headings and the caption. Its sides are even numbers, as MP4 requires."""
    from PIL import Image, ImageDraw, ImageFont

    height = max(picture.height for picture in drawn) + 2 * LINE
    frame = Image.new("RGB", (PANEL * len(drawn), height + height % 2), PAPER)
    pen = ImageDraw.Draw(frame)
    pen.font = ImageFont.load_default(TEXT)
    for place, (picture, heading) in enumerate(zip(drawn, headings, strict=True)):
        frame.paste(picture, (place * PANEL, LINE))
        pen.text((place * PANEL + 6, 2), heading, fill=INK)
    pen.text((6, height - LINE + 2), caption, fill=INK)
    return frame


def _mp4(frames: Iterator[Image], fps: int) -> bytes:
    """Encode frames as MP4. Raises ``ImportError``, ``RuntimeError`` or ``OSError`` if ffmpeg is missing or fails."""
    import imageio_ffmpeg

    first = next(frames)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "video.mp4"
        # settings with which browsers can play the file before it is loaded completely
        web: Any = ["-movflags", "+faststart", "-pix_fmt", "yuv420p"]
        writer = imageio_ffmpeg.write_frames(
            str(path), first.size, fps=fps, macro_block_size=2, output_params=web, ffmpeg_log_level="error"
        )
        writer.send(None)
        writer.send(np.asarray(first).tobytes())
        for frame in frames:
            writer.send(np.asarray(frame).tobytes())
        writer.close()
        return path.read_bytes()


def _gif(frames: Iterator[Image], seconds: float) -> bytes:
    """Encode frames, each shown for ``seconds``, as a GIF that plays once, because an endless animation disturbs a
    reader."""
    from PIL.Image import Palette

    first, *rest = (frame.convert("P", palette=Palette.ADAPTIVE, colors=64) for frame in frames)
    file = io.BytesIO()
    first.save(file, "GIF", save_all=True, append_images=rest, duration=round(1000 * seconds), optimize=False)
    return file.getvalue()
