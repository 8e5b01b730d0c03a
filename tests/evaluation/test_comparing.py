"""Real episodes held against a model: a right model is left alone, and a wrong one is found where it is wrong."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from support.moody import SPEC
from surrogym.cli.disagreement import Differing
from surrogym_trainer.evaluation.audit import Compared
from surrogym_trainer.evaluation.comparing import (
    MOST,
    Disagreements,
    disagreements,
    effects_of,
    samples_of,
    steady,
    steps_of,
)
from surrogym_trainer.evaluation.evaluator import Trace

NAMES = ("x", "reward")


def episodes(count: int, length: int) -> list[Trace]:
    rng = np.random.default_rng(0)
    return [
        Trace(rng.normal(size=(length + 1, 1)), rng.normal(size=(length, 1)), rng.normal(size=length), terminated=True)
        for _ in range(count)
    ]


def held(traces: list[Trace], errors: np.ndarray) -> Disagreements:
    steps = steps_of(traces)
    beside = Compared(NAMES, errors[: len(steps)], np.full((len(steps), 2), 0.05), np.array([0.0, 0.0]))
    return disagreements(steps, beside)


def test_few_real_steps_are_all_compared_and_many_are_thinned() -> None:
    few = steps_of(episodes(2, 10))
    assert [(step.episode, step.number) for step in few] == [(e, t) for e in range(2) for t in range(10)]
    assert [step.terminated for step in few] == ([False] * 9 + [True]) * 2
    many = steps_of(episodes(10, 300))
    assert len(many) == MOST
    assert {step.episode for step in many} == set(range(10))


@pytest.mark.parametrize("seed", range(10))
def test_errors_of_the_predicted_size_are_not_reported_as_disagreement(seed: int) -> None:
    errors = np.random.default_rng(seed).normal(scale=0.05, size=(MOST, 2))
    assert len(held(episodes(4, 100), errors).found) <= 1


def test_a_mispredicted_real_step_is_reported_with_episode_state_and_output() -> None:
    traces, errors = episodes(2, 10), np.zeros((20, 2))
    errors[13] = (0.0, -1.5)
    errors[15] = (0.9, 0.0)
    found = held(traces, errors)
    assert [(one.step.episode, one.step.number, one.output) for one in found.found] == [(1, 3, "reward"), (1, 5, "x")]
    assert found.by_episode() == {1: 2}
    assert found.missing == {0: 0.0, 1: -1.5}
    lines = Differing(found, 10_000).in_words(SPEC)
    assert lines[0] == "2 of 20 real steps differ from the model by more than the model's uncertainty"
    assert lines[1].startswith("  episode of seed 10001: 2 such steps; its compared steps earned 1.5 less than ")
    assert f"seed 10001, step 3, at x {traces[1].coordinates[3, 0]:.4g}: reward is -1.5 off the prediction" in lines[2]
    assert Differing(found, 10_000).as_json()["steps"][0]["seed"] == 10_001


def test_a_single_mispredicted_step_is_reported_in_the_singular() -> None:
    errors = np.zeros((20, 2))
    errors[13] = (0.9, 1.5)
    first, second, *_ = Differing(held(episodes(2, 10), errors), 0).in_words(SPEC)
    assert first.startswith("1 of 20 real steps differs from the model")
    assert second == "  episode of seed 1: 1 such step; its compared steps earned 1.5 more than predicted"


def test_rewards_within_the_claimed_errors_are_not_given_as_the_reason_of_a_loss() -> None:
    """A weaker pump cost the return, and the reason was "earned 1.3e-08 more than predicted"."""
    errors = np.zeros((20, 2))
    errors[13] = (0.9, 1.3e-8)
    found = held(episodes(2, 10), errors)
    assert found.missing[1] == pytest.approx(1.3e-8)
    _, second, *_ = Differing(found, 0).in_words(SPEC)
    assert "e-08" not in second
    assert second.endswith("earned what was predicted, so a loss comes from the states they lead to")


def test_no_real_step_is_reported_as_differing_from_a_correct_model() -> None:
    found = held(episodes(2, 10), np.zeros((20, 2)))
    assert Differing(found, 0).in_words(SPEC) == [
        "none of 20 real steps differs from the model by more than the model's uncertainty"
    ]


def test_samples_for_learning_are_the_worst_predicted_steps_of_each_episode_in_turn() -> None:
    traces, errors = episodes(2, 10), np.zeros((20, 2))
    errors[3], errors[4], errors[5], errors[12] = (4.0, 0.0), (3.0, 0.0), (2.0, 0.0), (1.0, 0.0)
    found = held(traces, errors)
    samples = samples_of(found, 3)
    expected = [(0, 3), (1, 2), (0, 4)]
    assert [sample.coordinates for sample in samples] == [traces[e].coordinates[t].tolist() for e, t in expected]
    assert [sample.next_coordinates for sample in samples] == [
        traces[e].coordinates[t + 1].tolist() for e, t in expected
    ]
    assert len(samples_of(found, 100)) == 4
    assert samples_of(found, 0) == []


def test_real_steps_in_which_a_coordinate_declared_constant_changed_are_not_compared_with_the_model() -> None:
    """A model keeps a setpoint. The step at which the plant changed it was shown as the model's error, and learned."""
    wanted = SPEC.coordinates[0].model_copy(update={"name": "wanted", "kind": "constant"})
    spec = SPEC.model_copy(update={"coordinates": (*SPEC.coordinates, wanted)})
    path = np.stack([np.linspace(0, 1, 7), [0.5, 0.5, 0.5 + 1e-9, 0.5, -0.2, -0.2, -0.2]], axis=1)
    steps = steps_of([Trace(path, np.zeros((6, 1)), np.zeros(6))])
    assert [step.number for step in steady(spec, steps)] == [0, 1, 2, 4, 5], "a change by rounding is none"
    assert steady(SPEC, steps) == steps
    none = Disagreements(5, (), {})
    said = Differing(none, 0, changed=("wanted",), left_out=1).in_words(spec)
    assert said[1] == "not compared: 1 real step, in which wanted changed, because the model keeps it constant"
    said = Differing(none, 0, changed=("wanted",), left_out=3).in_words(spec)
    assert said[1].startswith("not compared: 3 real steps, in each of which wanted changed")
    assert Differing(none, 0, left_out=3).as_json()["left_out"] == 3


def shared(error: float) -> Compared:
    """Steps of two episodes with a noise of 0.1 and a tolerance of 0.5. Errors of x share ``error`` where u > 0."""
    rng, steps = np.random.default_rng(0), steps_of(episodes(2, 60))
    q, u = (np.array([getattr(step, name) for step in steps]) for name in ("coordinates", "action"))
    errors = 0.1 * rng.normal(size=(len(steps), 2))
    errors[:, 0] += np.where(u[:, 0] > 0, error, 0.0)
    return Compared(
        NAMES, errors, np.zeros((len(steps), 2)), np.full(2, 0.5), claimed_alone=np.full(2, 0.3), states=q, actions=u
    )


def test_a_small_systematic_error_is_reported_with_its_region_and_cost() -> None:
    beside, steps = shared(0.3), steps_of(episodes(2, 60))
    (effect,), share = effects_of(SPEC, beside, lambda _, weights: 1e3 * weights[:, 0, 0])
    assert (effect.output, effect.region and effect.region.name) == ("x", "action 0")
    assert effect.error == pytest.approx(0.15, abs=0.05)
    assert effect.change == pytest.approx(150, abs=60)
    found = disagreements(steps, beside)
    assert not found.found
    first, *_, last = Differing(found, 0, effects=(effect,), broken=True).in_words(SPEC)
    assert first == "no single step shows why the return is below the promise"
    assert "x is +0.1" in last
    assert "where action 0 is between" in last
    explaining = [steps[i] for i in np.argsort(-share)]
    learned = samples_of(replace(found, shared=tuple(explaining)), 8)
    assert np.mean([sample.action[0] > 0 for sample in learned]) > 0.8, "the steps that show the error"


def test_no_systematic_error_is_found_in_a_correct_model_despite_a_missed_return() -> None:
    effects, share = effects_of(SPEC, shared(0.0), None)
    assert not effects
    assert not share.any()
    (said,) = Differing(Disagreements(120, (), {}), 0, broken=True).in_words(SPEC)
    assert said.startswith("the compared steps do not explain why the return is below the promise")
