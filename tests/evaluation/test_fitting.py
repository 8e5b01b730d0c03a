"""A policy acts only where its specification says what it observes and does."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest

from support.limited import SPEC as CART
from support.limited import with_limits
from support.moody import SPEC as LINE
from support.moody import Line
from support.rail import SPEC as RAIL
from surrogym_sampler.original.classic import pendulum
from surrogym_sampler.original.episodes import open_episode
from surrogym_sampler.original.errors import PolicyMisfit, UnknownEnvironment
from surrogym_sampler.original.fitting import check_policy
from surrogym_sampler.queries.query_limits import check_environment
from surrogym_shared.spec import BoxAction, DiscreteAction, EnvironmentSpec, ObservationEntry, Term, with_history
from surrogym_trainer.evaluation.evaluator import EvaluationSettings, evaluate


def changed(**fields: object) -> EnvironmentSpec:
    return LINE.model_copy(update=fields)


def acting(low: float, high: float, bins: int | None = None) -> EnvironmentSpec:
    return changed(action=BoxAction(low=(low,), high=(high,), bins=None if bins is None else (bins,)))


def test_evaluating_a_policy_of_another_environment_is_refused_before_the_first_reset() -> None:
    begun = []

    class Noting(Line):
        def step_from(self, coordinates, action):
            begun.append(action)
            return super().step_from(coordinates, action)

    run = partial(
        evaluate,
        lambda o: np.ones((len(o), 1)),
        partial(open_episode, "a line", None, Noting),
        EvaluationSettings(episodes=1),
    )
    with pytest.raises(PolicyMisfit, match=r"it is for Pendulum-v1: expected coordinates \(theta, speed\)"):
        run(trained_for=pendulum())
    assert begun == []
    run(trained_for=LINE)
    assert len(begun) == 20


@pytest.mark.parametrize(
    ("trained", "message"),
    [
        (changed(action=DiscreteAction(n=2)), "a discrete action of 1, got .* a box action of 1"),
        (acting(-1, 1, bins=5), "a box action of 1 in 5 bins, got .* a box action of 1$"),
        (acting(-2, 1), r"expected actions from \[-2\] to \[1\], got \[-1\] to \[1\]"),
        (
            changed(observation=(*LINE.observation, ObservationEntry(name="x2", term=Term.linear(x=2)))),
            r"expected observation \(x, x2\), got \(x\)$",
        ),
        (
            changed(observation=(ObservationEntry(name="x", term=Term.linear(x=2)),)),
            "'x' is another term than 'x'",
        ),
    ],
    ids=["discrete", "bins", "stronger", "observes more", "observes otherwise"],
)
def test_the_error_for_a_policy_that_does_not_fit_names_the_difference(trained: EnvironmentSpec, message: str) -> None:
    with pytest.raises(PolicyMisfit, match=message):
        check_policy(trained, LINE)


def test_a_policy_with_action_bins_of_other_bounds_is_refused() -> None:
    with pytest.raises(PolicyMisfit, match=r"expected actions from \[-1\] to \[1\], got \[-2\] to \[2\]"):
        check_policy(acting(-1, 1, bins=5), acting(-2, 2, bins=5))


def test_a_policy_trained_with_limits_is_refused_in_an_environment_without_them() -> None:
    """Nothing would keep the limits there: the sampler's guard reads the environment's own specification."""
    with pytest.raises(PolicyMisfit, match=r"got no limits: .* --spec FILE"):
        check_policy(CART, with_limits(None))
    assert CART.limits is not None
    wider = CART.limits.model_copy(update={"probability": 0.5})
    with pytest.raises(PolicyMisfit, match="got other limits"):
        check_policy(CART, with_limits(wider))
    check_policy(CART, CART)
    check_policy(with_limits(None), CART)


def test_a_policy_with_narrower_action_bounds_fits_the_environment() -> None:
    """A log shows fewer actions than the plant has, and steps from any state of a plant that can only be reset."""
    check_policy(acting(-0.5, 0.9), LINE)
    check_policy(LINE, RAIL)


def test_the_error_for_a_policy_that_does_not_fit_does_not_show_the_command_of_its_environment_program() -> None:
    with pytest.raises(PolicyMisfit) as refused:
        check_policy(pendulum().model_copy(update={"environment": "exec:rm -rf /"}), LINE)
    assert "rm" not in str(refused.value)


def test_an_environment_without_the_declared_lags_is_refused_with_the_advice_to_give_them() -> None:
    lagging = with_history(RAIL, actions=1)
    advice = r"got coordinates \(x\).*give the specification that declares the lags with --spec FILE$"
    with pytest.raises(PolicyMisfit, match=advice):
        check_policy(lagging, RAIL)
    with pytest.raises(UnknownEnvironment, match=advice):
        check_environment("rail", lagging, RAIL)
    with pytest.raises(UnknownEnvironment, match=r"register the environment under another name$"):
        check_environment("rail", RAIL, lagging)
