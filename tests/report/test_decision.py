"""The part for whoever decides says what it cost, what it gives and where it fails, and never more than was stored."""

from __future__ import annotations

import base64
import re
import shutil
from dataclasses import replace
from html import unescape
from typing import Any

import pytest

from support.server import ServerProcess
from surrogym_client.report.decision import decision, share
from surrogym_client.report.files import NoPdf, as_pdf
from surrogym_client.report.known import Known, chosen_real, chosen_reference, chosen_without
from surrogym_client.transport import Api
from surrogym_shared import wire

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


def told(known: Known) -> Parts:
    """The text of each section by its heading; of what stands before the first one under ''."""
    html = re.sub(r"<img[^>]*>", " [picture] ", decision(known, ()))
    parts = re.split(r"<h2>(.*?)</h2>", html)
    text = [unescape(re.sub(r"\s+", " ", re.sub(r"<[^>]+>", " ", part))).strip() for part in parts]
    return {"": text[0], **dict(zip(text[1::2], text[2::2], strict=True))}


def test_the_report_of_a_tested_policy_is_complete(modelled: Known):
    parts = told(replace(modelled, policy=policy(), real=evaluation(), without=without()))
    assert parts[""] == (
        "In 100 real episodes the controller earned -143.2 (-160.0 to -127.0) on average. 97 of 100 (92 % to 99.0 %) "
        "succeeded. Without it, from the same starts, the average was -1,280. Learning and checking it took 14 real "
        "steps."
    )
    assert re.search(r"learning the model 6 .*audit\) 8 .*without it 24,000 all together 24,014", parts["What it cost"])
    assert "589,824 steps in the model" in parts["What it cost"]
    assert "-0.089 / -140.0 / -300.0" in parts["What it gives"]
    assert parts["What it gives"].count("[picture]") == 1
    assert "From the same 20 starts, the average return was -140.0 with" in parts["With and without the controller"]
    assert "1,140 more with it" in parts["With and without the controller"]
    assert "Reality came out as predicted" in parts["Was it predicted?"]
    assert "Another unit of the machine" in parts["What was not tested"]
    assert "not every start succeeded" in parts["What to do next"]
    assert "surrogym evaluate policy.zip --reference module:Class" in parts["What to do next"]
    assert "What could not be read" not in parts


def test_a_video_is_inside_the_report(modelled: Known):
    known = replace(modelled, policy=policy(), real=evaluation(), video=("video/mp4", b"a video"))
    assert f'src="data:video/mp4;base64,{base64.b64encode(b"a video").decode()}"' in decision(known, [])
    assert "drawn from their states" in told(known)["What it gives"]


def test_a_reference_controller_stands_beside_the_policy(modelled: Known):
    other = evaluation(3, controller="reference", mean=-214.0, returns=[-150.0] * 60 + [-310.0] * 40)
    listed = policy(evaluations=[evaluation(), other])
    found = chosen_reference(listed, evaluation())
    assert found is not None
    assert found.id == 3
    parts = told(replace(modelled, policy=listed, real=evaluation(), without=without(), reference=other))
    assert "The reference controller earned -214.0 (-160.0 to -127.0) there." in parts[""]
    beside = parts["With and without the controller"]
    assert "with the reference controller: 10.0 more with it (95 %: 10.0 to 10.0)" in beside
    assert beside.count("[picture]") == 1
    assert "A controller of reference" not in parts["What was not tested"]
    assert "--reference" not in parts["What to do next"]


def test_a_broken_promise_comes_first_in_the_next_steps(modelled: Known):
    worse = evaluation(mean=-250.0, promise_kept=False)
    parts = told(replace(modelled, policy=policy(evaluations=[worse]), real=worse))
    assert "worse than predicted, by 80.2 beyond" in parts["Was it predicted?"]
    assert parts["What to do next"].startswith("Don't use it yet")
    assert "were not run without the controller" in parts["With and without the controller"]


def test_without_a_policy_each_section_says_so_and_the_model_is_shown(modelled: Known):
    parts = told(modelled)
    assert parts[""] == "There is a model of pendulum from 6 real steps, and no controller yet."
    assert parts["What it gives"] == "There is no controller yet."
    assert "surrogym train pendulum" in parts["What to do next"]
    assert "typical error" in parts["Where the model is unsure"]


def test_a_policy_without_real_episodes_says_how_to_get_some(modelled: Known):
    parts = told(replace(modelled, policy=policy(evaluations=[], promise=None, trusted=None)))
    assert "has not been tested in the original environment" in parts[""]
    assert parts["Was it predicted?"] == "Nothing was predicted."
    assert "surrogym evaluate policy.zip --compare zero" in parts["What to do next"]


def test_missing_traces_leave_the_numbers(modelled: Known):
    bare = evaluation(returns=[], lengths=[], traces=[], missing="gone")
    parts = told(replace(modelled, policy=policy(), real=bare, without=without(), missing=("the episodes are gone",)))
    assert "-143.2" in parts["What it gives"]
    assert "[picture]" not in parts["What it gives"]
    assert parts["What could not be read"] == "the episodes are gone"


def test_declared_starts_are_preferred_and_the_comparison_has_the_same(modelled: Known):
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


@pytest.mark.parametrize(("value", "words"), [(1, "100 %"), (0.99999, "99.9 %"), (0.5, "50 %"), (0.0, "0 %")])
def test_a_share_is_never_rounded_to_all(value: float, words: str):
    assert share(value) == words


def test_a_pdf_is_printed_where_chromium_is(monkeypatch: pytest.MonkeyPatch):
    page = "<!doctype html><title>Report</title><p>words</p>"
    if shutil.which("chromium") is not None:
        assert as_pdf(page).startswith(b"%PDF-")
    monkeypatch.setenv("PATH", "/nowhere")
    with pytest.raises(NoPdf, match="needs Chromium"):
        as_pdf(page)
