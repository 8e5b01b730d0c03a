"""The verdict by degree, and one next step with its cost."""

from __future__ import annotations

import math
from statistics import NormalDist
from typing import Any

import pytest

from surrogym_client.surrogates.advice import advice, noise_in_words, verdict
from surrogym_client.surrogates.waiting import (
    words_of_audit,
    words_of_design,
    words_of_uncertainty,
    words_of_waiting,
)
from surrogym_sampler.original.classic import pendulum
from surrogym_shared.spec import with_history
from surrogym_shared.wire import (
    DoubtfulRegion,
    Fidelity,
    Ledger,
    ModelView,
    OutputFidelity,
    QueryCounts,
    ReachedLimit,
    SurrogateView,
)

TARGET = 0.999


def output(name: str, index: float, error: float | None = 0.01, **fields: Any) -> OutputFidelity:
    known = {"structure": "", "confidence_index_paper": 1.0, "tolerance": 0.05, "coverage": 1.0, **fields}
    return OutputFidelity(name=name, confidence_index=index, leave_one_out_error=error, **known)


def fidelity(*outputs: OutputFidelity, samples: int = 40) -> Fidelity:
    index = min(one.confidence_index for one in outputs)
    return Fidelity(
        confidence_index=index, confidence_index_paper=1.0, target=TARGET, samples=samples, outputs=list(outputs)
    )


def view(*outputs: OutputFidelity, phase: str = "over_budget") -> SurrogateView:
    return SurrogateView(
        name="rig",
        environment="",
        phase=phase,
        paused=False,
        round=9,
        samples=40,
        model_version=9,
        confidence_index=None,
        target=TARGET,
        budget=40,
        ledger=Ledger(),
        queries=QueryCounts(),
        created_at=0.0,
        spec=pendulum(),
        budget_left=0,
        tolerances={},
        outputs=[],
        fidelity=fidelity(*outputs) if outputs else None,
    )


def models(indices: list[float], error: float = 0.01) -> list[ModelView]:
    """Fits of ten samples more each."""
    return [
        ModelView(
            version=i + 1,
            created_at=0.0,
            samples=10 * (i + 1),
            data_hash="",
            fidelity=fidelity(output("x", index, error)),
            fit_seconds=0.0,
            description={},
        )
        for i, index in enumerate(indices)
    ]


@pytest.mark.parametrize(
    ("outputs", "phase", "words"),
    [
        ((output("x", 1.0), output("r", 1.0)), "ready", "ready"),
        ((output("x", 1.0), output("r", 0.98)), "over_budget", "ready but for r (confidence 0.98 of 0.999)"),
        (
            (output("x", 1.0, error=0.2), output("r", 1.0)),
            "over_budget",
            "ready but for x (leave-one-out error 0.2, tolerance 0.05)",
        ),
        (
            (output("x", 0.99), output("r", 0.98)),
            "over_budget",
            "nearly ready: r (confidence 0.98 of 0.999), x (confidence 0.99 of 0.999)",
        ),
        (
            (output("x", 0.6), output("r", 0.98)),
            "over_budget",
            "not ready: x (confidence 0.6 of 0.999), r (confidence 0.98 of 0.999)",
        ),
    ],
)
def test_the_status_command_names_the_outputs_that_the_model_predicts_uncertainly(
    outputs: tuple[OutputFidelity, ...], phase: str, words: str
) -> None:
    assert verdict(view(*outputs, phase=phase)) == words


@pytest.mark.parametrize(
    ("low", "high", "outside", "words"),
    [
        (2.1, None, False, "above 2.1"),
        (None, 2.1, False, "below 2.1"),
        (-1.0, 350.2, False, "between -1 and 350"),
        (-6.0, 6.0, True, "below -6 or above 6"),
    ],
)
def test_the_status_sentence_states_the_range_where_an_output_is_uncertain(low, high, outside, words) -> None:
    region = DoubtfulRegion(input="theta", low=low, high=high, outside=outside, share=0.9)
    said = verdict(view(output("x", 1.0), output("r", 0.98, region=region)))
    assert said == f"ready but for r where theta is {words} (confidence 0.98 of 0.999)"


def test_with_detected_noise_a_larger_error_still_counts_as_certain() -> None:
    assert verdict(view(output("x", 1.0, error=0.06, noise=0.05), output("r", 0.9))).startswith("ready but for r")


def test_the_estimated_noise_is_shown_as_share_of_the_squared_error() -> None:
    said = noise_in_words(view(output("x", 1.0, error=0.05, noise=0.04), output("v", 1.0, error=0.1, noise=0.2)))
    assert said == "x 0.04 (64 % of its squared error), v 0.2 (100 % of its squared error)"
    said = noise_in_words(view(output("x", 1.0, error=0.05, noise=0.04, sensor_noise=0.03)))
    assert said == "x 0.04 (64 % of its squared error, mainly the sensor's: 0.03 a measurement)"
    assert noise_in_words(view(output("x", 1.0))) == noise_in_words(view()) == ""


def test_a_surrogate_without_model_gets_no_status_sentence_and_no_advice() -> None:
    assert verdict(view()) == ""
    assert advice(view(), []) == ""


def test_the_advised_number_of_steps_follows_the_progress_of_the_last_fits() -> None:
    """What it lacks falls by e in twenty samples: from e^-4 to 1e-3 that takes 58.2."""
    rate = [1 - 2.718281828 ** -(i / 2) for i in range(1, 9)]
    assert advice(view(output("x", rate[-1])), models(rate)) == (
        "about 59 more real steps at the present rate: surrogym improve rig --queries 59"
    )


@pytest.mark.parametrize("indices", [[0.7] * 8, [0.9, 0.9, 0.9, 0.9, 0.85, 0.8, 0.75, 0.7]])
def test_without_progress_a_reachable_tolerance_is_advised(indices: list[float]) -> None:
    said = advice(view(output("x", 0.7, error=0.2)), models(indices))
    assert "more real steps hardly help x" in said
    assert said.endswith("surrogym change rig --tolerance x=0.29")


def test_for_a_slowly_falling_error_the_advice_states_its_progress() -> None:
    falling = [models([0.7] * 8, error=error)[i] for i, error in enumerate([9, 9, 9, 9, 1.74, 1.5, 1.2, 1.05])]
    said = advice(view(output("x", 0.7, error=1.05)), falling)
    assert said.startswith(
        "the last 30 real steps lowered the leave-one-out error of x from 1.74 to 1.05, but its target"
    )
    assert "hardly" not in said


def test_after_few_rounds_the_advice_is_to_double_the_real_steps() -> None:
    said = advice(view(output("x", 0.7, error=0.2)), models([0.7, 0.7]))
    assert said.endswith("as many real steps again: surrogym improve rig --queries 40")


def test_the_advice_reports_an_output_that_never_varied() -> None:
    said = advice(view(output("reward", 0.5, error=0.08, tolerance=1e-90)), [])
    assert said.startswith("all initial samples had the same reward")


def noisy_output(index: float, error: float) -> OutputFidelity:
    """Its noise is 0.04 and its declared tolerance 0.03, so the server's tolerance is 0.05."""
    return output("x", index, error=error, noise=0.04, tolerance=0.05)


def test_no_further_real_steps_are_advised_if_the_error_is_mostly_noise() -> None:
    rising = [0.9, 0.92, 0.94, 0.96, 0.97, 0.98, 0.985, 0.99]
    said = advice(view(noisy_output(0.99, error=0.042)), models(rising))
    assert said.startswith("the error of x is nearly all noise (91 % of its square), which more real steps don't lower")
    assert "--queries" not in said


def test_an_error_explained_by_the_previous_step_gives_the_advice_to_declare_history() -> None:
    said = advice(view(output("x", 0.6, error=0.2, past=0.8)), models([0.6] * 12))
    assert "surrogym doctor --env ENVIRONMENT --history 60" in said
    assert "80 % of the squared error of x" in said
    assert "--tolerance" not in said


@pytest.mark.parametrize(("index", "error"), [(0.99, 0.08), (0.6, 0.042)])
def test_the_advice_does_not_call_an_error_noise_if_noise_explains_only_part(index: float, error: float) -> None:
    assert "nearly all noise" not in advice(view(noisy_output(index, error)), models([0.6, 0.6]))


@pytest.mark.parametrize(("index", "error"), [(0.99, 0.042), (0.9988, 0.042)])
def test_the_tolerance_advised_for_a_noisy_output_is_just_sufficient(index: float, error: float) -> None:
    """The server's index allows sqrt(tolerance^2 + noise^2), and the leave-one-out error 1.25 times as much. It leaves
    noise out that is smaller than the tolerance."""
    said = advice(view(noisy_output(index, error)), [])
    tolerance, z = float(said.rsplit("=", 1)[1]), NormalDist().inv_cdf
    deviation = math.hypot(0.03, 0.04) / z(index)
    noise = 0.04 if tolerance < 0.04 else 0.0
    assert math.hypot(tolerance, noise) / deviation == pytest.approx(z(TARGET), rel=0.05)
    assert error <= (1.25 if noise else 1.0) * math.hypot(tolerance, noise)


def test_without_progress_the_advice_reports_samples_ending_at_a_limit() -> None:
    limit = ReachedLimit(coordinate="level", side="upper", value=3.0, share=0.31)
    stuck = view(output("x", 0.7, error=0.2))
    assert stuck.fidelity is not None
    stuck = stuck.model_copy(update={"fidelity": stuck.fidelity.model_copy(update={"limits": [limit]})})
    said = advice(stuck, models([0.7] * 8))
    assert said.startswith("31 % of the samples end at the upper limit of level, 3, and say little about the dynamics")
    rate = [1 - 2.718281828 ** -(i / 2) for i in range(1, 9)]
    assert advice(stuck, models(rate)).startswith("about"), "real steps still help"


@pytest.mark.parametrize("phase", ["ready", "sampling", "from_log"])
def test_a_running_or_ready_design_gets_no_advice(phase: str) -> None:
    assert advice(view(output("x", 0.7), phase=phase), []) == ""


def test_the_waiting_message_asks_to_start_a_sampler_only_if_none_runs() -> None:
    idle = view(output("x", 0.7))
    start = "surrogym sample rig --env rig:Rig"
    assert words_of_waiting(idle, start).startswith(f"waiting for a sampler ({start}): 0 of 40 real steps")
    running = idle.model_copy(update={"samplers": ["beside"]})
    assert words_of_waiting(running, start).startswith("waiting for the sampler's answers: 0 of 40 real steps")


def test_waiting_messages_mention_a_running_fit() -> None:
    """An audit of a policy of 11,000 logged steps was silent for two minutes after its last real step."""
    fitting = view(output("x", 0.7), phase="fitting")
    fit = "; a model is being fitted to 40 steps"
    assert words_of_audit(fitting) == f"0 real steps of audits{fit}"
    assert words_of_design(fitting).endswith(f"confidence index 0.7000{fit}")
    assert words_of_waiting(fitting, "start") == words_of_design(fitting), "neither sampler nor answers are missing"
    asked = fitting.model_copy(update={"queries": QueryCounts(pending=2)})
    assert words_of_waiting(asked, "start").startswith("waiting for a sampler (start)")
    assert words_of_audit(view(output("x", 0.7), phase="ready")) == "0 real steps of audits"


def test_the_message_of_a_design_that_ended_unsure_names_confidence_index_and_target() -> None:
    assert words_of_uncertainty(view(output("x", 0.7))) == (
        "the design has spent its budget without being certain of its model: confidence index 0.7000, target 0.999"
    )


def test_where_only_policies_can_steer_the_next_step_is_a_training_with_trials():
    plain = pendulum().model_copy(update={"query": "rollout"})
    lagging = with_history(plain, changes=2, actions=1, largest={"theta": 1.0, "speed": 4.0})
    late = with_history(plain, changes=1, actions=2, largest={"theta": 1.0, "speed": 4.0})
    left = {"phase": "unsure", "budget": 100, "budget_left": 60}
    waiting = view(output("theta", 0.5)).model_copy(update={"spec": lagging, **left})
    assert advice(waiting, []) == (
        "trials of policies take the other 60 real steps of the budget, while a sampler runs: surrogym train rig"
    )
    for spec in (plain, late):
        assert "surrogym train" not in advice(waiting.model_copy(update={"spec": spec}), []), "a planner can steer"
    assert "surrogym train" not in advice(waiting.model_copy(update={"budget_left": 0}), [])
