"""Tolerances that nobody set: frozen, but for those of samples that met nothing."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from support.plane import drifting, plane
from surrogym_server.convert import definition_from_spec
from surrogym_server.sampling.tolerances import (
    FLOOR,
    TOLERANCE,
    DefaultTolerances,
    default_tolerances,
    frozen_tolerances,
    sizes_of,
)
from surrogym_shared.spec import Design

DEFINITION = definition_from_spec(plane())
NOTHING_MET = drifting(lambda q, _: (-800 * q.square().sum(-1)).exp() * 1e-100, 5)
PAID = drifting(lambda q, _: (-q.square().sum(-1)).exp(), 6)


def frozen(samples, before=None):
    return frozen_tolerances(DEFINITION, samples, before or DefaultTolerances())


def test_a_reward_tolerance_frozen_without_rewards_is_recomputed_at_the_first_reward():
    first = frozen(NOTHING_MET)
    assert first.values[-1] < 1e-100
    second = frozen(PAID, first)
    assert second.values[-1] == pytest.approx(TOLERANCE * float(PAID.reward.std(correction=0)))
    assert second.values[:-1] == first.values[:-1]


def test_a_default_tolerance_from_varied_rewards_stays_frozen():
    first = frozen(PAID)
    paid_more = replace(PAID, reward=100 * PAID.reward)
    assert frozen(paid_more, first) == first


def test_the_tolerance_of_a_constant_reward_is_recomputed_once_it_varies():
    constant = replace(PAID, reward=torch.ones(6, dtype=torch.float64))
    first = frozen(constant)
    assert first.values[-1] == TOLERANCE
    assert frozen(replace(PAID, reward=1 + 1e-3 * PAID.reward), first).values[-1] < 1e-4


def test_a_terminal_reward_does_not_change_the_reward_tolerance():
    first = frozen(NOTHING_MET)
    ended = replace(NOTHING_MET, reward=NOTHING_MET.reward.clone(), terminated=NOTHING_MET.terminated.clone())
    ended.reward[0], ended.terminated[0] = 1.0, True
    assert frozen(ended, first) == first


def test_a_design_state_stored_without_ranges_keeps_its_tolerances():
    assert frozen(PAID, DefaultTolerances((1e-12,) * 3)) == DefaultTolerances((1e-12,) * 3)


def test_the_tolerance_of_increments_of_rounding_size_has_a_lower_limit():
    still = replace(PAID, q_next=PAID.q * (1 + 3e-16))
    tolerance = default_tolerances(DEFINITION, sizes_of(DEFINITION, still))
    assert min(tolerance[:2]) == pytest.approx(TOLERANCE * FLOOR / 3**0.5)


def test_with_setting_raw_every_tolerance_is_one_for_any_samples():
    raw = definition_from_spec(plane().model_copy(update={"design": Design(tolerance="raw")}))
    first = frozen_tolerances(raw, NOTHING_MET, DefaultTolerances())
    assert frozen_tolerances(raw, PAID, first).values == (1.0, 1.0, 1.0)


def test_tolerances_of_a_design_with_snapshots_can_only_grow():
    """Its first samples lie near the resets, so their deviation is far below that over the sampling range."""
    definition = definition_from_spec(plane().model_copy(update={"query": "rollout", "snapshots": True}))
    first = frozen_tolerances(definition, PAID, DefaultTolerances())
    assert first == frozen(PAID)
    more = replace(PAID, reward=3 * PAID.reward, q_next=PAID.q + 2 * (PAID.q_next - PAID.q))
    grown = frozen_tolerances(definition, more, first)
    assert grown.values == pytest.approx([2 * first.values[0], 2 * first.values[1], 3 * first.values[2]])
    assert frozen_tolerances(definition, PAID, grown) == grown
    constant = replace(PAID, reward=torch.ones(6, dtype=torch.float64))
    varied = frozen_tolerances(definition, replace(PAID, reward=1 + 1e-3 * PAID.reward), frozen(constant))
    assert varied.values[-1] < 1e-4, "that of a constant reward is taken again, as without snapshots"
