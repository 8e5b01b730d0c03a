"""Processes that are alike share samples: inputs are matched, evidence decides, and each sees its own unit."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from surrogym_server.gp import FitOptions, Part, Reflection, condition, fit, pools
from surrogym_server.gp.pooling import Pool

OPTIONS = FitOptions()


def f(a: Tensor, b: Tensor) -> Tensor:
    return torch.sin(1.5 * a) - 0.5 * b**2


def part(of: tuple[int, int], seed: int, n: int = 25, size: int = 5, scale: float = 1.0, **kept: object) -> Part:
    """A process of ``size`` inputs whose targets are a function ``of`` two of them, in this order."""
    x = 2 * torch.rand(n, size, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) - 1
    target = scale * f(x[:, of[0]], x[:, of[1]]) + 3
    centre, std = float(target.mean()), float(target.std(correction=0))
    y = (target - centre) / std
    inputs = tuple(sorted(of))
    whole, fewer = fit(x, y, OPTIONS), fit(x[:, list(inputs)], y, OPTIONS)
    made = Part(x, y, whole.posterior.hyper, centre, std, OPTIONS, inputs, fewer.posterior.hyper, signs=None)
    return replace(made, **kept)


@pytest.fixture(scope="module")
def pool() -> Pool:
    """Two processes that are one function of other inputs, in another order."""
    (found,) = pools([part((0, 3), 0), part((4, 1), 1)], most=4)
    return found


def test_pooling_matches_corresponding_inputs_of_similar_processes(pool):
    first, second = (dict(zip(("own", "other"), inputs, strict=True)) for inputs in pool.inputs)
    known = {0: "a", 3: "b"} if pool.numbers[0] == 0 else {4: "a", 1: "b"}
    rival = {4: "a", 1: "b"} if pool.numbers[0] == 0 else {0: "a", 3: "b"}
    assert [known[i] for i in first.values()] == [rival[i] for i in second.values()]
    assert pool.gain > 2 * 25


def test_pooling_finds_the_relevant_inputs_of_a_process_itself(pool):
    """The second one thinks that it reads all inputs."""
    lost = part((4, 1), 1, reads=tuple(range(5)))
    lost = replace(lost, fewer=lost.hyper)
    (found,) = pools([part((0, 3), 0), lost], most=4)
    assert sorted(found.inputs[1]) == [1, 4]


def test_pooled_processes_predict_better_with_the_samples_of_both(pool):
    x = 2 * torch.rand(300, 5, generator=torch.Generator().manual_seed(9), dtype=torch.float64) - 1
    for member, own in enumerate(pool.parts):
        a, b = (0, 3) if pool.numbers[member] == 0 else (4, 1)
        truth = (f(x[:, a], x[:, b]) + 3 - pool.parts[0].centre) / own.scale
        inputs = sorted(pool.inputs[member])
        together = condition(*(pool.samples_of(member, 100)[i] for i in (2, 0, 1)))
        alone = own.posterior.mean(x[:, inputs]) + (own.centre - pool.parts[0].centre) / own.scale
        errors = [(mean - truth).square().mean().sqrt() for mean in (together.mean(x[:, inputs]), alone)]
        assert errors[0] < 0.7 * errors[1]


def test_a_pooled_process_keeps_its_own_samples_and_a_limited_number_of_others(pool):
    for member, own in enumerate(pool.parts):
        x, y, _ = pool.samples_of(member, 40)
        assert x.shape == (40, 2)
        torch.testing.assert_close(x[:25], own.x[:, sorted(pool.inputs[member])])
        torch.testing.assert_close(own.scale * y[:25] + pool.parts[0].centre, own.scale * own.y + own.centre)


def test_the_pooling_gain_is_joint_minus_separate_log_marginal_likelihood(pool):
    """In units of the targets: evidence apart does not depend on how each process is standardised."""
    x, y, _ = pool.samples_of(0, 1000)
    first = pool.parts[0]
    back = [pool.inputs[0].index(place) for place in sorted(pool.inputs[0])]
    together = first.evidence(pool.hyper, x[:, [back.index(i) for i in range(2)]], y)
    apart = sum(own.alone for own in pool.parts) + math.log(math.perm(5, 2))
    assert pool.gain == pytest.approx(together - apart, abs=1e-6)


def test_processes_of_different_functions_are_not_pooled():
    other = part((4, 1), 1)
    other = replace(other, y=-other.y.flip(0))
    assert pools([part((0, 3), 0), other], most=4) == []


def test_processes_of_functions_with_different_scale_are_not_pooled():
    """The same shape, but three times as large."""
    assert pools([part((0, 3), 0), part((4, 1), 1, scale=3.0)], most=4) == []


def test_processes_with_more_inputs_than_the_limit_are_not_pooled():
    assert pools([part((0, 3), 0), part((4, 1), 1)], most=1) == []


def odd(of: tuple[int, int], seed: int, signs: Tensor) -> Part:
    """A process that is odd in its inputs."""
    mirror = Reflection(-torch.ones(2, dtype=torch.float64), -1)
    plain = part(of, seed)
    y = torch.sin(1.5 * plain.x[:, of[0]]) - plain.x[:, of[1]] ** 3
    fewer = fit(plain.x[:, sorted(of)], y, OPTIONS, reflection=mirror).posterior.hyper
    whole = fit(plain.x, y, OPTIONS).posterior.hyper
    return replace(plain, y=y, centre=0.0, scale=1.0, hyper=whole, fewer=fewer, signs=signs)


def test_odd_processes_are_pooled_only_if_matched_inputs_mirror_alike():
    """An odd function reads no input that stays in the mirror image, and none if there is no mirror image."""
    turned = -torch.ones(5, dtype=torch.float64)
    known, other = odd((0, 3), 0, turned), odd((4, 1), 1, turned)
    assert len(pools([known, other], most=4)) == 1
    stays = torch.where(torch.arange(5) == 1, 1.0, turned)
    unread = {"reads": tuple(range(5)), "fewer": other.hyper}
    assert pools([known, replace(other, signs=stays, **unread)], most=4) == []
    assert pools([known, replace(other, signs=None, **unread)], most=4) == []


def test_pooled_processes_of_odd_functions_have_mean_zero():
    """A part that was standardised around its average sees the pool around 0, where an odd function is 0."""
    turned = -torch.ones(5, dtype=torch.float64)
    known, plain = odd((0, 3), 0, turned), odd((4, 1), 1, turned)
    other = replace(plain, y=(plain.y - 0.2) / 0.5, centre=0.2, scale=0.5)
    (found,) = pools([known, other], most=4)
    member = found.numbers.index(1)
    x, y, hyper = found.samples_of(member, 100)
    torch.testing.assert_close(0.5 * y[:25], plain.y)
    foretold, _ = condition(hyper, x, y).leave_one_out()
    assert float((foretold - y).abs().max()) < 0.05
