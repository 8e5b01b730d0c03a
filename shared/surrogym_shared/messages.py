"""Find where one WebSocket frame ends and the next begins (RFC 6455, section 5.2), for whole binary messages.

A step is one whole, uncompressed binary message in each direction. Client and server parse such messages themselves,
and pass every other frame to the library that implements the protocol.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

try:
    from websockets.speedups import apply_mask
except ImportError:  # without a compiled extension of websockets on this platform
    from websockets.utils import apply_mask

__all__ = ["KEY_BYTES", "MASKED", "WHOLE_BINARY", "Extent", "FrameSplitter", "apply_mask", "extent_of", "header"]

WHOLE_BINARY = 0x82  # first byte of a WebSocket frame: last fragment, no extension, opcode 2 (binary)
MASKED = 0x80
_TWO_BYTES, _EIGHT_BYTES = 126, 127
_SHORT, _LONG = struct.Struct("!H"), struct.Struct("!Q")
KEY_BYTES = 4


@dataclass(frozen=True, slots=True)
class Extent:
    """Positions in a WebSocket frame, counted from its first byte: the beginning of its masking key, the beginning of
    its payload, and its end."""

    key: int  # position of the masking key; equal to ``payload`` if the frame is not masked
    payload: int
    end: int


def extent_of(content: bytes | bytearray) -> Extent | None:
    """Return the positions in the WebSocket frame with which the content begins; None if its header is incomplete."""
    if len(content) < 2:
        return None
    size, key = content[1] & 0x7F, 2
    if size == _TWO_BYTES:
        if len(content) < 4:
            return None
        (size,), key = _SHORT.unpack_from(content, 2), 4
    elif size == _EIGHT_BYTES:
        if len(content) < 10:
            return None
        (size,), key = _LONG.unpack_from(content, 2), 10
    payload = key + KEY_BYTES if content[1] & MASKED else key
    return Extent(key, payload, payload + size)


def header(size: int, masked: int = 0) -> bytes:
    """Return the WebSocket header of a whole binary message of ``size`` bytes. ``masked`` is ``MASKED`` if a masking
    key follows, else 0."""
    if size < _TWO_BYTES:
        return bytes((WHOLE_BINARY, masked | size))
    if size < 65_536:
        return bytes((WHOLE_BINARY, masked | _TWO_BYTES)) + _SHORT.pack(size)
    return bytes((WHOLE_BINARY, masked | _EIGHT_BYTES)) + _LONG.pack(size)


class FrameSplitter:
    """Splits and joins incoming chunks of bytes into whole WebSocket frames.

    ``max_bytes`` is the longest payload to join. Chunks of a longer payload are returned unchanged, so that the library
    refuses them. ``max_frames`` is the largest number of frames in one chunk. From a chunk with more frames,
    ``max_frames`` + 1 are returned, so that the caller sees that there are too many, and the rest is dropped.
    """

    def __init__(self, max_bytes: float = float("inf"), max_frames: float = float("inf")) -> None:
        self._max_bytes = max_bytes
        self._max_frames = max_frames
        self._rest = bytearray()
        self._due = 0  # a frame that ``_rest`` has in part can't be complete before ``_rest`` has this number of bytes

    @property
    def rest_bytes(self) -> int:
        """Number of received bytes of a frame that is not complete yet."""
        return len(self._rest)

    def split(self, chunk: bytes) -> list[tuple[bytes, Extent | None]]:
        """Return the frames that this chunk completes, in order, each with the positions of its parts.

        A frame that is too long has None instead of the positions.
        """
        if self._rest:
            self._rest += chunk
            if len(self._rest) < self._due:
                return []
            chunk = bytes(self._rest)
            self._rest.clear()
        frames: list[tuple[bytes, Extent | None]] = []
        while chunk and len(frames) <= self._max_frames:
            extent = extent_of(chunk)
            if extent is not None and extent.end - extent.payload > self._max_bytes:
                return [*frames, (chunk, None)]
            if extent is None or extent.end > len(chunk):
                self._rest += chunk
                self._due = 0 if extent is None else extent.end
                break
            frames.append((chunk[: extent.end], extent))  # if the frame is the whole chunk, this slice is no copy
            chunk = chunk[extent.end :]
        return frames
