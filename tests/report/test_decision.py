"""The part for whoever decides says what it cost, what it gives and where it fails, and never more than was stored."""

from __future__ import annotations

import base64
import re
import shutil
from collections.abc import Sequence
from dataclasses import replace
from html import unescape
from typing import Any

import numpy as np
import pytest

from support.server import ServerProcess
from surrogym_client.transport import Api
from surrogym_shared import wire
from surrogym_shared.spec import Inequality, Success, Term
from surrogym_shared.wire.policies import PolicyFallback
from surrogym_trainer.coverage import Cut
from surrogym_trainer.policies.evidence import chosen_real
from surrogym_trainer.report.decision import cost, criterion, decision, original, outcome, share
from surrogym_trainer.report.known import Known, chosen_reference, chosen_without
from surrogym_trainer.report.page import NoPdf, as_pdf

SEED = 10_000
Parts = dict[str, str]


def trace(rank: wire.TraceRank, level: float) -> wire.EpisodeTrace:
    states = [[3.0 + 0.1 * i, level] for i in range(4)]
    return wire.EpisodeTrace(rank=rank, seed=SEED, coordinates=states, action=[[level]] * 3, reward=[level] * 3)


def evaluation(id: int = 1, **fields: Any) -> wire.EvaluationDetail:
    interval, returns = wire.Interval(low=-160.0, high=-127.0), [-140.0] * 60 + [-300.0] * 40
    given = {
        "controller": "policy",
        "created_at": 0.0,
        "note": "declared starts",
        "declared": True,
        "environment": "",
        "own": True,
        "seeded": True,
        "first_seed": SEED,
        "episodes": 100,
        "steps": 20_000,
        "mean": -143.2,
        "mean_interval": interval,
        "median": -140.0,
        "least": -300.0,
        "most": -0.089,
        "success_rate": 0.97,
        "success_interval": wire.Interval(low=0.915, high=0.99),
        "promise_kept": True,
        "returns": returns,
        "lengths": [200] * 100,
        "success": None,
        "traces": [trace("paired", -1.0), trace("best", -0.03), trace("median", -0.5), trace("worst", -1.5)],
    }
    return wire.EvaluationDetail(id=id, **{**given, **fields})


def without(**fields: Any) -> wire.EvaluationDetail:
    alone = {"controller": "zero", "mean": -1280.0, "episodes": 20, "steps": 4_000, "returns": [-1280.0] * 20}
    return evaluation(2, **{**alone, "success_rate": None, "success_interval": None, "promise_kept": None, **fields})


def policy(**fields: Any) -> wire.PolicyDetail:
    given: dict[str, Any] = {
        "version": 3,
        "created_at": 0.0,
        "aliases": [],
        "algorithm": "PPO",
        "virtual_steps": 589_824,
        "imagined_return": -159.8,
        "promise": wire.PolicyPromise(median=-151.9, low=-169.8, high=-134.0),
        "audit": wire.PolicyAudit(steps=8, passed=True),
        "trusted": True,
        "reason": "8 real steps on the policy's way agree with the model",
        "differs": None,
        "files": [],
        "evaluations": [evaluation()],
        "seed": 0,
        "seconds": 25.0,
        "settings": {},
        "versions": {},
        "curve": [],
    }
    return wire.PolicyDetail(**{**given, **fields})


@pytest.fixture(scope="module")
def modelled(pendulum_server: ServerProcess) -> Known:
    """A surrogate that has no policy."""
    with Api(pendulum_server.url) as api:
        ledger = wire.Ledger(initial=4, adaptive=2, total=6, audit=8, evaluation=24_000)
        view = api.surrogate("pendulum").model_copy(update={"ledger": ledger, "samples": 14})
        return Known(view, api.models("pendulum"), [], "here")


def told(known: Known, cuts: Sequence[Cut] = ()) -> Parts:
    """The text of each section by its heading; of what stands before the first one under ''."""
    html = re.sub(r"<img[^>]*>", " [picture] ", decision(known, cuts))
    parts = re.split(r"<h2>(.*?)</h2>", html)
    text = [unescape(re.sub(r"\s+", " ", re.sub(r"<[^>]+>", " ", part))).strip() for part in parts]
    return {"": text[0], **dict(zip(text[1::2], text[2::2], strict=True))}


def test_the_report_of_an_evaluated_policy_has_every_section(modelled: Known):
    parts = told(replace(modelled, policy=policy(), real=evaluation(), without=without()))
    assert parts[""].startswith(
        "In 100 real episodes the controller earned -143.2 (-160.0 to -127.0) on average. 97 of 100 (92 % to 99.0 %) "
        "succeeded. From the first 20 of these 100 starts, it earned -140.0 on average, and no controller (an action "
        "of zero all the time) earned -1,280. Learning and checking it took 14 real steps, and testing took 24,000 "
        "more."
    )
    assert "589,824 steps in the model" in parts["What it cost"]
    assert "-0.089 / -140.0 / -300.0" in parts["What it gives"]
    assert parts["What it gives"].count("[picture]") == 1
    assert "From the first 20 of these 100 starts, the average return" in parts["With and without the controller"]
    assert "1,140 more with it" in parts["With and without the controller"]
    assert "Reality came out as predicted" in parts["Was it predicted?"]
    assert "Another unit of the machine" in parts["What was not tested"]
    assert "not every start succeeded" in parts["What to do next"]
    assert "surrogym evaluate policy.zip --reference module:Class" in parts["What to do next"]
    assert "What could not be read" not in parts


def test_the_report_names_the_set_points_of_the_returns_and_the_limits_of_a_planner(modelled: Known):
    aimed = policy(settings={"session": {"set_points": {"speed": 1.5}}, "limits": ["speed<=2", "speed>=0"]})
    parts = told(replace(modelled, policy=aimed, real=evaluation()))
    assert "set points of the returns speed = 1.5" in parts["What it gives"]
    assert "limits at run time speed<=2, speed>=0" in parts["What it gives"]
    assert "set points" not in told(replace(modelled, policy=policy(), real=evaluation()))["What it gives"]


def test_the_report_lists_every_real_step_by_purpose(modelled: Known):
    wide = evaluation(4, declared=False, note="starts anywhere", steps=3_000)
    older = policy(version=2, evaluations=[evaluation(5, steps=500)])
    known = replace(modelled, policy=policy(evaluations=[evaluation(), without(), wide]), others=(older,))
    counted = modelled.view.ledger.model_copy(update={"evaluation": 28_000})
    known = replace(known, view=modelled.view.model_copy(update={"ledger": counted}))
    lines = dict(re.findall(r"<tr><td>(.*?)</td><td>([0-9,]+)</td></tr>", cost(known)))
    assert lines["100 episodes with the controller, starts anywhere"] == "3,000"
    assert lines["episodes with 1 other version of the controller"] == "500"
    assert lines["other real episodes, of which no result is stored"] == "500"
    *parts, total = (int(count.replace(",", "")) for count in lines.values())
    assert sum(parts) == total == 28_014


def test_the_report_explains_why_more_steps_than_planned_were_taken(modelled: Known):
    ledger = wire.Ledger(initial=5, adaptive=55, total=60)
    design = modelled.view.spec.design.model_copy(update={"budget": 24})
    spec = modelled.view.spec.model_copy(update={"design": design})
    changes = {"ledger": ledger, "spec": spec, "budget": 60, "phase": "over_budget"}
    words = told(replace(modelled, view=modelled.view.model_copy(update=changes)))["What it cost"]
    assert "24 real steps were planned at first. 36 more were allowed later" in words
    assert "60 were taken. Then learning ended, although the model was not yet known well enough" in words


def test_the_report_shows_evaluations_from_other_start_ranges(modelled: Known):
    wide = evaluation(4, declared=False, note="starts anywhere, from seed 10000", mean=-113.6)
    tried = told(replace(modelled, policy=policy(evaluations=[evaluation(), wide]), real=evaluation()))
    assert "starts anywhere 100 -113.6" in tried["What it gives"]
    assert "Tested were: declared starts (100 episodes); starts anywhere (100 episodes)" in tried["What was not tested"]
    assert "Starts outside the declared ones" not in tried["What was not tested"]
    bare = told(replace(modelled, policy=policy(), real=evaluation()))
    assert "Starts outside the declared ones" in bare["What was not tested"]


@pytest.mark.parametrize(
    ("mean", "low", "high", "verdict"),
    [
        (-150.0, -160.0, -140.0, "as predicted"),
        (-133.999, -133.9995, -133.998, "as predicted"),
        (-133.0, -140.0, -126.0, "as predicted"),
        (-120.0, -126.0, -114.0, "better"),
        (-170.0, -180.0, -160.0, "perhaps worse"),
        (-250.0, -260.0, -240.0, "worse"),
    ],
)
def test_the_report_calls_returns_different_only_beyond_both_confidence_intervals(
    mean: float, low: float, high: float, verdict: str
):
    promise = wire.PolicyPromise(median=-151.9, low=-169.8, high=-134.0)
    assert outcome(promise, evaluation(mean=mean, mean_interval=wire.Interval(low=low, high=high))).verdict == verdict


def test_the_report_states_no_difference_between_controllers_within_the_confidence_interval(modelled: Known):
    returns = [-140.0, -139.0] * 50
    other = without(episodes=100, returns=returns)
    real = evaluation(returns=[-139.0, -140.0] * 50)
    beside = told(replace(modelled, policy=policy(), real=real, without=other))["With and without the controller"]
    assert "No difference was shown: the controller's gain is 0 (95 %" in beside
    assert " more with it" not in beside


def test_the_report_does_not_call_unmatched_start_states_the_same(modelled: Known):
    few = without(returns=[], traces=[])
    parts = told(replace(modelled, policy=policy(), real=evaluation(returns=[]), without=few))
    assert "can't be compared one by one" in parts["With and without the controller"]
    assert "same" not in parts[""]


@pytest.mark.parametrize(
    ("deviation", "words"), [(0.5, "show no region where the model is unsure"), (2.0, "show where: in up to 100 %")]
)
def test_the_reports_sentence_about_model_uncertainty_matches_its_maps(modelled: Known, deviation: float, words: str):
    cut = Cut(0, 1, np.full((3, 3), deviation), np.ones((3, 3)), np.zeros((3, 3)))
    assert words in told(modelled, [cut])["Where the model is unsure"]


def test_the_report_of_a_user_defined_environment_class_recommends_valid_commands(modelled: Known):
    spec = modelled.view.spec.model_copy(update={"success": None, "environment": "rail"})
    view = modelled.view.model_copy(update={"spec": spec, "environment": "rail"})
    bare = evaluation(success_rate=None, success_interval=None)
    parts = told(replace(modelled, view=view, policy=policy(), real=bare))
    assert "can't tell how many episodes failed" in parts[""]
    assert "no success was declared" in parts["What to do next"]
    assert "surrogym policy get pendulum@3 --out policy.zip" in parts["What to do next"]
    assert "surrogym evaluate policy.zip --env YOUR.MODULE:CLASS --wide" in parts["What to do next"]
    assert "--perturb" not in parts["What to do next"]


def test_the_report_explains_success_criteria_and_the_real_environment(modelled: Known):
    parts = told(replace(modelled, policy=policy(), real=evaluation()))
    assert "which is the simulator Pendulum-v1 here. No machine was used." in parts[""]
    assert "An episode succeeds if cos(theta) > 0.95 in each of its last 20 steps." in parts[""]
    assert "Only the owner knows whether it drives the machine" in original("rail:Rail")
    near = Inequality(term=2 * Term.linear(x=1, v=-1) + Term.constant(-1), relation="<=", value=0.1)
    assert criterion(Success(hold=(near,), terminated=False, min_return=-5)) == (
        "An episode succeeds if 2 (x - v) - 1 <= 0.1 at its end, and no rule of the specification ends it, and its "
        "return is at least -5."
    )


def test_the_report_contains_the_evaluation_video(modelled: Known):
    known = replace(modelled, policy=policy(), real=evaluation(), video=("video/mp4", b"a video"))
    assert f'src="data:video/mp4;base64,{base64.b64encode(b"a video").decode()}"' in decision(known, [])
    assert "drawn from their states" in told(known)["What it gives"]


def test_the_report_shows_the_reference_controller_beside_the_policy(modelled: Known):
    other = evaluation(3, controller="reference", mean=-214.0, returns=[-150.0] * 60 + [-310.0] * 40)
    listed = policy(evaluations=[evaluation(), other])
    found = chosen_reference(listed, evaluation())
    assert found is not None
    assert found.id == 3
    parts = told(replace(modelled, policy=listed, real=evaluation(), without=without(), reference=other))
    assert "From the same starts, it earned -204.0 on average, and the reference controller earned -214.0." in parts[""]
    beside = parts["With and without the controller"]
    assert "-214.0 with the reference controller. That is 10.0 more with it (95 %: 10.0 to 10.0)" in beside
    assert beside.count("[picture]") == 1
    assert "A controller of reference" not in parts["What was not tested"]
    assert "--reference" not in parts["What to do next"]


def test_the_report_lists_a_missed_promised_return_first_among_the_next_steps(modelled: Known):
    worse = evaluation(mean=-250.0, mean_interval=wire.Interval(low=-260.0, high=-240.0), promise_kept=False)
    parts = told(replace(modelled, policy=policy(evaluations=[worse]), real=worse))
    assert "worse than predicted, by 80.2 beyond" in parts["Was it predicted?"]
    assert parts["What to do next"].startswith("Don't use it yet")
    assert "were not run without the controller" in parts["With and without the controller"]


def test_the_report_does_not_recommend_an_untrusted_policy_for_production(modelled: Known):
    """It earned what was promised, but the first next step says not to use it."""
    parts = told(replace(modelled, policy=policy(trusted=False, reason="the audit failed"), real=evaluation()))
    assert parts["What to do next"].startswith("Don't use it yet")
    assert "policy alias" not in parts["What to do next"]
    assert "policy alias" in told(replace(modelled, policy=policy(), real=evaluation()))["What to do next"]


@pytest.mark.parametrize("tested", [True, False])
def test_after_drift_the_report_only_recommends_starting_again(modelled: Known, tested: bool):
    """Real steps of the changed machine would be mixed with those of the old one."""
    drifted = policy(trusted=False, reason="since today, drift: speed is off", drifted_at=1.0)
    parts = told(replace(modelled, policy=drifted, real=evaluation() if tested else None))
    assert "drift: speed is off" in parts["Was it predicted?"]
    assert "the machine has changed" in parts["What to do next"]
    assert "surrogym" not in parts["What to do next"]


def test_the_report_without_a_policy_says_so_and_shows_the_model(modelled: Known):
    parts = told(modelled)
    assert parts[""] == "There is a model of pendulum from 6 real steps, and no controller yet."
    assert parts["What it gives"] == "There is no controller yet."
    assert "surrogym train pendulum" in parts["What to do next"]
    assert "typical error" in parts["Where the model is unsure"]


def test_the_report_of_an_unevaluated_policy_tells_how_to_evaluate(modelled: Known):
    parts = told(replace(modelled, policy=policy(evaluations=[], promise=None, trusted=None)))
    assert "has not been tested in the original environment" in parts[""]
    assert parts["Was it predicted?"] == "Nothing was predicted."
    assert "surrogym evaluate policy.zip --compare zero" in parts["What to do next"]


def test_the_report_shows_the_expected_share_of_episodes_with_a_fallback(modelled: Known):
    share = PolicyFallback(mean=0.031, median=0.0, low=0.0, high=0.09)
    promise = wire.PolicyPromise(median=-151.9, low=-169.8, high=-134.0, fallback=share)
    said = told(replace(modelled, policy=policy(promise=promise)))["Was it predicted?"]
    assert "the fallback is expected in 3.1 % of the episodes (0 to 9 %), so no more leave a limit" in said


def test_the_report_shows_numbers_although_episode_traces_are_missing(modelled: Known):
    bare = evaluation(returns=[], lengths=[], traces=[], missing="gone")
    parts = told(replace(modelled, policy=policy(), real=bare, without=without(), missing=("the episodes are gone",)))
    assert "-143.2" in parts["What it gives"]
    assert "[picture]" not in parts["What it gives"]
    assert parts["What could not be read"] == "the episodes are gone"


def test_the_report_prefers_evaluations_from_declared_starts_with_equal_seeds(modelled: Known):
    wide = evaluation(5, declared=False, note="starts anywhere")
    other = without(first_seed=7)
    listed = policy(evaluations=[evaluation(1), without(), other, wide])
    real = chosen_real(listed)
    assert real is not None
    assert real.id == 1
    found = chosen_without(listed, real)
    assert found is not None
    assert found.first_seed == SEED
    assert chosen_without(listed, wide) is None


def test_the_report_lists_episodes_in_another_environment_separately(modelled: Known):
    heavy = {"own": False, "environment": "maglev:Heavy"}
    elsewhere, other = evaluation(8, mean=-3.7, **heavy), without(**heavy)
    listed = policy(evaluations=[evaluation(1), elsewhere, other])
    real = chosen_real(listed)
    assert real is not None
    assert real.id == 1
    assert chosen_without(listed, real) is None
    told_ = told(replace(modelled, policy=listed, real=evaluation()))
    assert "in maglev:Heavy: declared starts 100 -3.7" in told_["What it gives"]
    assert "in maglev:Heavy: declared starts (100 episodes)" in told_["What was not tested"]
    assert chosen_real(policy(evaluations=[elsewhere])) is None


def test_the_report_does_not_compare_episodes_without_seeds() -> None:
    unseeded = [evaluation(1, seeded=False), without(seeded=False)]
    assert chosen_without(policy(evaluations=unseeded), unseeded[0]) is None


@pytest.mark.parametrize(("value", "words"), [(1, "100 %"), (0.99999, "99.9 %"), (0.5, "50 %"), (0.0, "0 %")])
def test_a_percentage_in_the_report_is_never_rounded_up_to_100(value: float, words: str):
    assert share(value) == words


def test_the_report_is_printed_as_pdf_if_chromium_is_installed(monkeypatch: pytest.MonkeyPatch):
    page = "<!doctype html><title>Report</title><p>words</p>"
    if shutil.which("chromium") is not None:
        assert as_pdf(page).startswith(b"%PDF-")
    monkeypatch.setenv("PATH", "/nowhere")
    with pytest.raises(NoPdf, match="needs Chromium"):
        as_pdf(page)
