"""Sentences that say what was found about an environment while its specification was drafted."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from surrogym_sampler.original.describing.probing import EXACT, Probed
from surrogym_shared.spec import DeclaredReward


def words_of_reward(reward: DeclaredReward) -> str:
    """Return in words what kind of function a declared reward is."""
    bonus = reward.terms[0]
    if bonus.when:
        several = f"{len(bonus.when)} thresholds of quantities of the state, all met at once,"
        return "a threshold of a quantity of the state" if len(bonus.when) == 1 else several
    return (
        "an ellipsoid of quantities of the state"
        if bonus.shape == "ball"
        else "a quadratic function of coordinates and actions"
    )


def words_of_access(probed: Probed, fixed: str) -> str:
    """Return a sentence about the states in which an environment can begin.

    Args:
        probed: results of repeated steps.
        fixed: the sentence for an environment that can't be set to a state.
    """
    if not np.isfinite(probed.set_error):
        return fixed
    if not probed.settable:
        return (
            f"a step from a set state differs from the same step within an episode by {probed.set_error:.2g} of "
            "its range: the environment has memory that can't be set, so it can only be reset"
        )
    noise = f"; two steps from one state differ by {probed.repeat_error:.2g}" if probed.noisy else ""
    same = "that of an episode" if probed.set_error <= EXACT else f"that of an episode within {probed.set_error:.2g}"
    return f"it can be set to any state: a step from there is {same}{noise}"


def listed(names: Sequence[str]) -> str:
    """Return the names separated by commas."""
    return ", ".join(names)
