"""Noise is Philox, normal, and a pure function of its key: the same lane draws the same, whatever runs beside it."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.stats import kstest

from surrogym_server.virtual import VirtualSettings, create, noise
from surrogym_server.virtual.lanes import LaneState
from surrogym_server.virtual.noise import Purpose, normal_noise, uniform_noise
from surrogym_server.virtual.philox import normals, philox, uniforms
from surrogym_shared import compiled

ONES = 0xFFFFFFFF


@pytest.mark.parametrize(
    ("counter", "key", "expected"),
    [
        ((0, 0, 0, 0), (0, 0), (0x6627E8D5, 0xE169C58D, 0xBC57AC4C, 0x9B00DBD8)),
        ((ONES,) * 4, (ONES,) * 2, (0x408F276D, 0x41C83B0E, 0xA20BC7C6, 0x6D5451FD)),
        (
            (0x243F6A88, 0x85A308D3, 0x13198A2E, 0x03707344),
            (0xA4093822, 0x299F31D0),
            (0xD16CFE09, 0x94FDCCEB, 0x5001E420, 0x24126EA1),
        ),
    ],
)
def test_philox_gives_the_known_answers_of_random123(counter, key, expected):
    words = philox(tuple(map(torch.tensor, counter)), tuple(map(torch.tensor, key)))
    assert words.tolist() == list(expected)


@pytest.mark.skipif(not compiled.available(), reason="numba is not installed, or switched off")
def test_compiled_philox_equals_that_of_torch(lanes, monkeypatch):
    lanes = replace(lanes, seed=np.array([0, 1, 2**31, 2**32, 2**40 + 5, 2**62, 2**63 - 1, ONES]))
    words = noise._words(lanes, Purpose.PROCESS, 5, 9)
    monkeypatch.setattr(compiled, "available", lambda: False)
    assert torch.equal(words, noise._words(lanes, Purpose.PROCESS, 5, 9))


def test_uniform_noise_never_reaches_0_or_1():
    ends = uniforms(torch.tensor([0, ONES]))
    assert 0 < float(ends[0]) < 1e-9
    assert 1 - 1e-9 < float(ends[1]) < 1
    assert torch.isfinite(normals(torch.tensor([0, ONES, ONES, 0]))).all()


@pytest.fixture
def lanes(pendulum_model) -> LaneState:
    made = create(pendulum_model.definition, VirtualSettings(8), seed=2**40 + 5)
    return replace(made, episode=np.arange(8) % 3, elapsed=10 * np.arange(8))


def test_normal_and_uniform_noise_have_their_distributions(lanes):
    normal = normal_noise(lanes, Purpose.TRANSITION, 2_000, 3)
    assert normal.shape == (8, 2_000, 3)
    assert kstest(normal.flatten().numpy(), "norm").pvalue > 0.01
    assert np.abs(np.corrcoef(normal.permute(0, 2, 1).reshape(24, -1).numpy()) - np.eye(24)).max() < 0.1
    uniform = uniform_noise(lanes, Purpose.START, 2_000)
    assert uniform.shape == (8, 2_000)
    assert kstest(uniform.flatten().numpy(), "uniform").pvalue > 0.01


def test_the_noise_of_an_environment_does_not_depend_on_the_number_of_environments(lanes):
    alone = lanes.take(np.array([3]))
    assert torch.equal(
        normal_noise(lanes, Purpose.TRANSITION, 5, 3)[3:4], normal_noise(alone, Purpose.TRANSITION, 5, 3)
    )
    assert torch.equal(uniform_noise(lanes, Purpose.START, 6)[3:4], uniform_noise(alone, Purpose.START, 6))


def test_noise_of_more_particles_extends_that_of_fewer(lanes):
    few, many = (normal_noise(lanes, Purpose.TRANSITION, count, 3) for count in (4, 9))
    assert torch.equal(many[:, :4], few)


@pytest.mark.parametrize("part", ["seed", "lane", "episode", "elapsed"])
def test_changing_any_part_of_the_noise_key_changes_the_noise(lanes, part):
    changed = replace(lanes, **{part: getattr(lanes, part) + 1})
    one, other = (normal_noise(a, Purpose.TRANSITION, 2, 2) for a in (lanes, changed))
    assert not torch.isclose(one, other).any()


def test_changing_high_bits_of_the_seed_changes_the_noise(lanes):
    one, other = (uniform_noise(replace(lanes, seed=lanes.seed + s), Purpose.START, 2) for s in (0, 2**33))
    assert not torch.isclose(one, other).any()


def test_random_numbers_for_different_purposes_are_never_the_same(lanes):
    draws = [uniform_noise(lanes, purpose, 4) for purpose in Purpose]
    assert len(torch.stack(draws).unique()) == 4 * 8 * len(Purpose)
