"""Whole frames come out of any chunks, and what a library writes is taken apart as it would do it."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st
from websockets.frames import Frame, Opcode

from surrogym_shared.messages import MASKED, WHOLE_BINARY, FrameSplitter, apply_mask, extent_of, header

SIZES = (0, 1, 125, 126, 65_535, 65_536)


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("mask", [False, True])
def test_websocket_frames_equal_those_of_the_websockets_library(size: int, mask: bool):
    payload = bytes(i % 251 for i in range(size))
    frame = Frame(Opcode.BINARY, payload).serialize(mask=mask, extensions=[])
    extent = extent_of(frame)
    assert extent is not None
    assert (frame[0], extent.end) == (WHOLE_BINARY, len(frame))
    assert frame[: extent.key] == header(size, MASKED if mask else 0)
    read = frame[extent.payload :]
    assert (apply_mask(read, frame[extent.key : extent.payload]) if mask else read) == payload


@given(
    st.lists(st.tuples(st.sampled_from([Opcode.BINARY, Opcode.PING]), st.binary(max_size=300)), max_size=5),
    st.lists(st.integers(1, 400), min_size=1, max_size=30),
)
def test_whole_websocket_frames_are_extracted_from_arbitrary_chunks(sent: list[tuple[Opcode, bytes]], cuts: list[int]):
    written = [Frame(opcode, payload[:125]).serialize(mask=True, extensions=[]) for opcode, payload in sent]
    stream, splitter, found, i = b"".join(written), FrameSplitter(), [], 0
    while stream:
        size, i = cuts[i % len(cuts)], i + 1
        found += splitter.split(stream[:size])
        stream = stream[size:]
    assert [frame for frame, _ in found] == written


def test_a_too_long_websocket_message_is_passed_on_unchanged():
    splitter, announced = FrameSplitter(max_bytes=100), header(101, MASKED)
    assert splitter.split(announced[:1]) == []
    assert splitter.split(announced[1:]) == [(announced, None)]
