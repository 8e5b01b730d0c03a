"""A surrogate's file says what it was given, and what is none is refused in words, whatever its bytes."""

from __future__ import annotations

import json
from contextlib import suppress

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from safetensors.numpy import load, save

from surrogym_sampler.original.classic import pendulum
from surrogym_shared import surrogate_file
from surrogym_shared.surrogate_file import NotASurrogateFile, RealSamples, SurrogateFile

MODEL = save({"0.inputs": np.arange(6.0).reshape(3, 2), "flag": np.array([True])}, {"surrogym": '{"format": 3}'})


def samples(n: int = 4) -> RealSamples:
    rng = np.random.default_rng(0)
    pairs = rng.normal(size=(2, n, 2))
    return RealSamples(pairs[0], rng.normal(size=(n, 1)), pairs[1], rng.normal(size=n), *(rng.random((2, n)) < 0.5))


WHOLE = SurrogateFile("pendulum", pendulum(), MODEL, samples())
DATA = WHOLE.to_bytes()


def rewritten(change) -> bytes:
    """The file with its header changed."""
    length = int.from_bytes(DATA[:8], "little")
    header = json.loads(DATA[8 : 8 + length])
    change(header)
    text = json.dumps(header).encode()
    return len(text).to_bytes(8, "little") + text + DATA[8 + length :]


@pytest.mark.parametrize("n", [0, 1, 7])
def test_a_surrogate_file_is_read_back_unchanged(n: int):
    written = SurrogateFile("a.b", pendulum(), MODEL, samples(n))
    read = SurrogateFile.from_bytes(written.to_bytes())
    assert (read.name, read.spec) == ("a.b", pendulum())
    for field in RealSamples.__dataclass_fields__:
        np.testing.assert_array_equal(getattr(read.samples, field), getattr(written.samples, field))
    assert json.loads(read.model[8 : 8 + int.from_bytes(read.model[:8], "little")])["__metadata__"] == {
        "surrogym": '{"format": 3}'
    }
    for name, array in load(MODEL).items():
        np.testing.assert_array_equal(load(read.model)[name], array)


def test_a_surrogate_file_can_be_opened_by_safetensors():
    arrays = load(DATA)
    np.testing.assert_array_equal(arrays["samples.reward"], WHOLE.samples.reward)
    np.testing.assert_array_equal(arrays["0.inputs"], load(MODEL)["0.inputs"])


def own(header) -> dict:
    return json.loads(header["__metadata__"]["surrogate"])


def with_own(header, **fields) -> None:
    header["__metadata__"]["surrogate"] = json.dumps(own(header) | fields)


HOSTILE = {
    "another format": lambda h: with_own(h, format=2),
    "no specification": lambda h: with_own(h, spec={}),
    "a specification that is no object": lambda h: with_own(h, spec=7),
    "a specification of other sizes": lambda h: with_own(
        h,
        spec=pendulum()
        .model_copy(update={"action": pendulum().action.model_copy(update={"low": (-1,) * 2, "high": (1,) * 2})})
        .model_dump(mode="json"),
    ),
    "metadata that is no text": lambda h: h["__metadata__"].update(surrogate=5),
    "no metadata": lambda h: h.pop("__metadata__"),
    "metadata that is a list": lambda h: h.update(__metadata__=[]),
    "samples missing": lambda h: h.pop("samples.reward"),
    "samples beyond the end": lambda h: h["samples.reward"].update(data_offsets=[10**12, 10**12 + 32]),
    "samples before the start": lambda h: h["samples.reward"].update(data_offsets=[-32, 0]),
    "samples of huge shape": lambda h: h["samples.reward"].update(shape=[2**62]),
    "samples of negative shape": lambda h: h["samples.reward"].update(shape=[-4]),
    "samples of another dtype": lambda h: h["samples.reward"].update(dtype="O"),
    "samples of different lengths": lambda h: h["samples.reward"].update(shape=[3], data_offsets=[0, 24]),
    "tolerances that are none": lambda h: with_own(h, tolerances={"theta": "small"}),
    "a ledger that is a list": lambda h: with_own(h, ledger=[1]),
    "a name that leads elsewhere": lambda h: with_own(h, name="../pendulum"),
    "a name of dots": lambda h: with_own(h, name=".."),
    "a name that is none": lambda h: with_own(h, name=None),
    "an entry that is a number": lambda h: h.update({"samples.reward": 3}),
}


@pytest.mark.parametrize("change", HOSTILE.values(), ids=HOSTILE)
def test_a_surrogate_file_with_contradicting_content_is_refused(change):
    with pytest.raises(NotASurrogateFile, match=r"expected|contradicts"):
        SurrogateFile.from_bytes(rewritten(change))


@pytest.mark.parametrize(
    "data",
    [b"", b"PK\x03\x04", b"\x80\x04cposix\nsystem\n", DATA[:-1], (2**63).to_bytes(8, "little") + DATA[8:], MODEL],
    ids=["empty", "zip", "pickle", "cut", "endless header", "a model alone"],
)
def test_a_file_that_is_not_a_surrogate_file_is_refused(data: bytes):
    with pytest.raises(NotASurrogateFile, match="expected"):
        SurrogateFile.from_bytes(data)


def test_a_surrogate_file_with_deeply_nested_json_is_refused():
    text = b"[" * 100_000
    with pytest.raises(NotASurrogateFile, match="header in JSON"):
        SurrogateFile.from_bytes(len(text).to_bytes(8, "little") + text)


def test_a_surrogate_file_beyond_the_size_limits_is_refused(monkeypatch, tmp_path):
    monkeypatch.setattr(surrogate_file, "MAX_FILE_BYTES", len(DATA) - 1)
    (tmp_path / "large.surrogate").write_bytes(DATA)
    with pytest.raises(
        NotASurrogateFile, match=r"large\.surrogate can't be used: expected a surrogate.s file of at most"
    ):
        SurrogateFile.load(tmp_path / "large.surrogate")


@settings(max_examples=200)
@given(st.lists(st.tuples(st.integers(0, len(DATA) - 1), st.integers(0, 255)), min_size=1, max_size=4))
def test_a_randomly_changed_surrogate_file_is_read_or_refused_without_a_crash(changes):
    mutated = bytearray(DATA)
    for place, byte in changes:
        mutated[place] = byte
    with suppress(NotASurrogateFile):
        SurrogateFile.from_bytes(bytes(mutated))
