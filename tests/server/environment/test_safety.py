"""Limits at states of a planner's grid: where the fallback acts, and its action."""

from __future__ import annotations

import numpy as np
import torch

from support import limited
from surrogym_server.convert import definition_from_spec
from surrogym_shared.limits import clipped_action, fallback_action, falls_back
from surrogym_shared.spec import Limits
from surrogym_shared.spec.safety import NamedFallback

SPEC = limited.SPEC
STATES = np.random.default_rng(0).uniform((-1.5, -3), (1.5, 3), (2_000, 2))


def test_actions_are_the_fallbacks_within_a_margin_and_their_own_elsewhere():
    definition, asked = definition_from_spec(SPEC), torch.full((len(STATES), 1), 0.5, dtype=torch.float64)
    got = definition.with_fallback(torch.from_numpy(STATES), asked).numpy()
    near = falls_back(SPEC, STATES, STATES)
    assert 0 < near.sum() < len(near)
    assert (got[~near] == 0.5).all()
    np.testing.assert_allclose(got[near], [fallback_action(SPEC, q) for q in STATES[near]])
    assert (got == clipped_action(SPEC, got)).all()


def test_a_fallback_that_is_a_program_and_an_environment_without_limits_leave_actions_as_they_are():
    named = Limits(keep=limited.LIMITS.keep, fallback=NamedFallback(name="brake"))
    asked = torch.full((len(STATES), 1), 0.5, dtype=torch.float64)
    for spec in (limited.with_limits(named), limited.with_limits(None)):
        assert definition_from_spec(spec).with_fallback(torch.from_numpy(STATES), asked) is asked
