"""Drawing with NumPy alone: a stroke colours each pixel by the pixel's distance from a line.

Shapes: a frame is (height, width, 3) float64, 0 to 255. Points are in the world's units, y upwards from the middle.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Frame = NDArray[np.float64]
Point = tuple[float, float]
Colour = tuple[int, int, int]

WHITE = 255.0


class Canvas:
    """A white frame on which strokes are drawn.

    Args:
        width: width in pixels.
        height: height in pixels.
        scale: pixels for each unit of the world, whose origin is in the middle.
    """

    def __init__(self, width: int, height: int, scale: float) -> None:
        self._frame: Frame = np.full((height, width, 3), WHITE)
        self._scale = scale
        self._x = (np.arange(width) + 0.5 - width / 2) / scale  # horizontal position of each pixel column (width,)
        # Vertical position of each pixel row (height, 1).
        self._y = (height / 2 - np.arange(height) - 0.5)[:, None] / scale

    def stroke(self, start: Point, end: Point, thickness: float, colour: Colour) -> None:
        """Draw a line with round ends; if both ends are the same point, a disc."""
        (ax, ay), (bx, by) = start, end
        dx, dy = bx - ax, by - ay
        along = ((self._x - ax) * dx + (self._y - ay) * dy) / max(dx**2 + dy**2, 1e-12)
        nearest = np.clip(along, 0.0, 1.0)
        away = np.hypot(self._x - ax - nearest * dx, self._y - ay - nearest * dy) - thickness / 2
        # share of each pixel that the stroke covers; its edges are one pixel wide
        cover = np.clip(0.5 - away * self._scale, 0.0, 1.0)[..., None]
        self._frame += cover * (np.array(colour) - self._frame)

    def picture(self) -> NDArray[np.uint8]:
        """Return the frame as (height, width, 3) uint8."""
        return np.round(self._frame).astype(np.uint8)
