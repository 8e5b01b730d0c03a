"""An evaluation counts the episodes that left a limit, and the steps in which the fallback acted."""

from __future__ import annotations

import json

import numpy as np
import pytest

from support.limited import RAIL, SPEC, Cart, PatientCart, with_limits
from support.rated import RATED, RatedRail
from surrogym_sampler.original.episodes import open_episode
from surrogym_sampler.original.errors import EvaluationFailed
from surrogym_shared.limits import KeptEpisodes
from surrogym_shared.spec import Limits, Term
from surrogym_trainer.evaluation.evaluator import Evaluation, EvaluationSettings, evaluate, limits_kept


def pushed_right(*, limited: bool) -> Evaluation:
    """Evaluate a policy that always pushes the cart to the right."""
    spec = SPEC if limited else with_limits(None)
    return evaluate(
        lambda shown: np.ones((len(shown), 1)),
        lambda: open_episode("cart:Cart", spec, lambda: PatientCart(spec)),
        EvaluationSettings(episodes=3),
    )


def counted(violations: int, episodes: int) -> KeptEpisodes:
    return KeptEpisodes(episodes, violations, 0, 0, 40 * episodes, {"rail": 0.0}, 0.01)


def test_a_policy_that_drives_off_the_rail_is_stopped_by_the_fallback_and_counted() -> None:
    kept = pushed_right(limited=True).limits
    assert kept is not None
    assert (kept.violations, kept.episodes, kept.steps) == (0, 3, 120)
    assert 0 < kept.fallbacks < kept.steps
    assert kept.least_room["rail"] >= 0


def test_the_trace_of_an_evaluation_has_the_actions_that_were_applied() -> None:
    result = pushed_right(limited=True)
    applied = np.concatenate([trace.action for trace in result.traces])
    assert result.limits is not None
    assert int((applied != 1.0).sum()) == result.limits.fallbacks


def test_the_trace_of_an_evaluation_under_a_rate_has_the_actions_that_were_applied() -> None:
    result = evaluate(
        lambda shown: np.where(shown[:, :1] > 0, -1.0, 1.0),
        lambda: open_episode("rail:Rail", RATED, RatedRail),
        EvaluationSettings(episodes=2),
    )
    for trace in result.traces:
        assert np.abs(np.diff(trace.action[:, 0], prepend=0.0)).max() <= 0.5 + 1e-6
        np.testing.assert_allclose(trace.coordinates[1:, -1], trace.action[:, 0])


def test_without_declared_limits_an_evaluation_reports_none_and_the_cart_leaves_the_rail() -> None:
    result = pushed_right(limited=False)
    assert result.limits is None
    assert "limits" not in result.summary()
    kept = limits_kept(SPEC, [trace.coordinates for trace in result.traces], [0, 0, 0])
    assert kept.violations == 3
    assert kept.least_room["rail"] < 0


@pytest.mark.parametrize(
    ("violations", "episodes", "broken"),
    [(0, 100, False), (1, 8, False), (1, 4, True), (3, 100, False), (4, 100, True)],
)
def test_limits_count_as_broken_if_chance_does_not_explain_the_violations(
    violations: int, episodes: int, broken: bool
) -> None:
    """At an allowed 1 %, one violation in four episodes has a probability of 3.9 %, one in eight of 7.7 %."""
    assert counted(violations, episodes).broken == broken


def test_the_summary_of_limits_is_json_with_an_exact_interval() -> None:
    summary = json.loads(json.dumps(counted(0, 100).summary()))
    assert summary["interval"] == pytest.approx([0.0, 0.0362], abs=1e-4)
    assert "0 of 100 episodes left a limit (95 % interval 0 to 3.6 %" in counted(0, 100).words()
    assert "2 of 2 episodes left a limit (95 % interval 16 to 100 %" in counted(2, 2).words()


def test_an_evaluation_of_a_machine_ends_early_if_the_limits_are_left_more_often_than_allowed() -> None:
    spec = with_limits(Limits(keep=(RAIL,), fallback=(Term.constant(1.0),)))  # a fallback that drives off the rail
    always = lambda shown: np.ones((len(shown), 1))  # noqa: E731
    said: list[str] = []
    stopped = evaluate(
        always, lambda: open_episode("cart:Cart", spec, lambda: Cart(spec)), EvaluationSettings(10), remark=said.append
    )
    assert len(stopped.returns) == 2
    assert [line for line in said if line.startswith("2 of 2 episodes left a limit")]
    simulated = evaluate(
        always, lambda: open_episode("cart:Cart", spec, lambda: PatientCart(spec)), EvaluationSettings(10)
    )
    assert len(simulated.returns) == 10, "nothing is damaged in a simulator"


class Breaks(PatientCart):
    """A cart that breaks in its 150th step."""

    taken = 0

    def step(self, action):
        self.taken += 1
        if self.taken == 150:
            raise OSError("a wheel broke")
        return super().step(action)


def test_an_evaluation_that_fails_still_says_how_its_episodes_kept_the_limits() -> None:
    spec = with_limits(Limits(keep=(RAIL,), fallback=(Term.constant(1.0),)))  # a fallback that drives off the rail
    with pytest.raises(EvaluationFailed, match="a wheel broke") as failed:
        evaluate(
            lambda shown: np.ones((len(shown), 1)),
            lambda: open_episode("cart:Cart", spec, lambda: Breaks(spec)),
            EvaluationSettings(10, parallel=1),
        )
    kept = failed.value.limits
    assert kept is not None
    assert kept.steps == 149
    assert 1 < kept.violations <= kept.fallback_episodes <= kept.episodes < 10
