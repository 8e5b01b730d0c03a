"""``surrogym sample`` at a machine with limits: queries are shown before they are taken, and a person approves them."""

from __future__ import annotations

import json
import re
import shlex
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer

from support.controllers import network
from support.limited import DIARY, LIMITS, SPEC, Cart, NamedCart
from support.programs import FALLS_BACK, KEEPS_LIMITS, program
from support.rail import SPEC as RAIL
from support.rated import CHANGE
from surrogym.cli.commands import sample
from surrogym_client.transport import Api
from surrogym_sampler.original.episodes import open_episode
from surrogym_shared.archives import stored as archive
from surrogym_shared.spec import Term, with_history
from surrogym_shared.wire import Query
from surrogym_trainer.evaluation.evaluator import EvaluationSettings, evaluate
from surrogym_trainer.policies import PolicyCard

CART = ("--env", "support.limited:PatientCart")


@pytest.fixture
def cart(on_server: Any, name: str) -> str:
    assert on_server("register", name, *CART).code == 0
    return name


def test_sampling_with_dry_run_shows_the_pending_queries_and_takes_no_real_step(on_server: Any, cart: str) -> None:
    shown = on_server("sample", cart, *CART, "--dry-run")
    assert "(initial): 1 step from a reset" in shown.out
    assert "action 0" in shown.out
    assert len(json.loads(on_server("sample", cart, *CART, "--dry-run", "--json").out)["queries"]) == 5
    assert json.loads(on_server("status", cart, "--json").out)["ledger"]["total"] == 0


def test_the_suggested_sampling_command_has_the_file_that_declares_the_limits(
    on_server: Any, name: str, tmp_path: Path
) -> None:
    """The class declares none, and a sampler needs the surrogate's limits in its own specification."""
    file = tmp_path / "limits.json"
    file.write_text(SPEC.model_dump_json())
    free = "support.limited:FreeCart"
    said = on_server("register", name, "--env", free, "--spec", str(file)).out.strip()
    suggested = shlex.split(said.rpartition("next: surrogym ")[2])
    assert suggested[-2:] == ["--spec", str(file)]
    assert on_server(*suggested[:-2], "--max-queries", "1").code != 0
    assert on_server(*suggested, "--max-queries", "1").code == 0


def test_the_suggested_sampling_command_has_the_file_that_declares_the_lags(
    on_server: Any, name: str, tmp_path: Path
) -> None:
    file = tmp_path / "lags.json"
    file.write_text(with_history(RAIL, actions=1).model_dump_json())
    said = on_server("register", name, "--env", "support.rail:Rail", "--spec", str(file)).out.strip()
    assert shlex.split(said)[-2:] == ["--spec", str(file)]


def test_sampling_keeps_the_rate_of_an_action_and_stores_the_applied_actions(
    on_server: Any, server_process: Any, name: str
) -> None:
    rated = ("--env", "support.rated:RatedRail")
    assert on_server("register", name, *rated).code == 0
    assert on_server("sample", name, *rated, "--max-queries", "2").code == 0
    with Api(server_process.url) as api:
        samples = list(api.samples(name))
    assert len(samples) > 2
    assert max(abs(one.action[0] - one.coordinates[-1]) for one in samples) <= CHANGE + 1e-6


def test_a_query_the_user_does_not_approve_takes_no_real_step(
    on_server: Any, cart: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[Query] = []

    def second_refused(_: Any, query: Query) -> bool:
        asked.append(query)
        return len(asked) != 2

    monkeypatch.setattr(sample, "approved", second_refused)
    monkeypatch.setattr("sys.stdin.isatty", lambda: True)
    said = on_server("sample", cart, *CART, "--approve", "--max-queries", "3", "--json")
    report = json.loads(said.out)
    assert (report["answered"], report["refused"]) == (2, 1)
    assert report["steps"] == sum(len(query.actions) for query in (asked[0], asked[2]))
    assert "1 refused by the environment" in on_server("status", cart).out


def test_sampling_with_approve_shows_each_query_before_asking_for_approval(
    monkeypatch: pytest.MonkeyPatch, on_server: Any, cart: str
) -> None:
    questions: list[str] = []
    monkeypatch.setattr(typer, "confirm", lambda question, **_: questions.append(question) or False)
    monkeypatch.setattr("sys.stdin.isatty", lambda: True)
    said = on_server("sample", cart, *CART, "--approve", "--max-queries", "1")
    assert questions == ["take it?"]
    assert "(initial): 1 step from a reset" in said.err


def test_interrupting_the_approval_question_ends_the_sampler_without_counting_a_step(
    monkeypatch: pytest.MonkeyPatch, on_server: Any, cart: str
) -> None:
    questions: list[str] = []

    def ended(question: str, **_: object) -> bool:
        questions.append(question)
        raise typer.Abort

    monkeypatch.setattr(typer, "confirm", ended)
    monkeypatch.setattr("sys.stdin.isatty", lambda: True)
    said = on_server("sample", cart, *CART, "--approve")
    assert len(questions) == 1
    assert "interrupted after 0 queries" in said.err
    assert json.loads(on_server("status", cart, "--json").out)["ledger"]["unresolved"] == 0


def test_sampling_with_approve_is_refused_without_a_terminal(on_server: Any, cart: str) -> None:
    said = on_server("sample", cart, *CART, "--approve")
    assert said.code != 0
    assert "expected a terminal" in said.err


def test_sampling_a_program_with_limits_warns_before_it_starts_that_only_the_program_falls_back_after_a_kill(
    on_server: Any, name: str, cart: str, tmp_path: Path
) -> None:
    command = program(tmp_path, KEEPS_LIMITS, FALLS_BACK)
    on_server("register", f"exec:{command}", "--name", name + "-program")
    said = on_server("sample", name + "-program", "--exec", command, "--max-queries", "1").err
    assert said.index("only the program itself can fall back") < said.index("answered")
    assert "kill" not in on_server("sample", cart, *CART, "--max-queries", "1").err


def test_a_sampler_whose_rollouts_leave_a_limit_more_often_than_allowed_ends_before_the_next_query(
    on_server: Any, name: str
) -> None:
    leaving = ("--env", "support.limited:LeavingCart")
    on_server("register", name, *leaving)
    said = on_server("sample", name, *leaving, "--until-done")
    assert said.code != 0
    stopped = re.search(
        r"(\d) of (\d) rollouts of this sampler left a limit \(rail: \1\), which is clearly more than", said.err
    )
    assert stopped is not None
    assert "choose a larger margin, a smaller range of actions, or a fallback that keeps the limits" in said.err
    view = json.loads(on_server("status", name, "--json").out)
    assert (view["ledger"]["unresolved"], view["queries"]["leased"]) == (0, 0)
    assert view["queries"]["answered"] == int(stopped[2])
    assert view["queries"]["pending"] > 0


def test_sampling_and_evaluating_with_a_named_fallback_need_its_program(
    on_server: Any, name: str, tmp_path: Path
) -> None:
    named, program_of = ("--env", "support.limited:NamedCart"), ("--fallback", "brake=support.limited:brake")
    registered = on_server("register", name, *named)
    assert registered.out.endswith(" --fallback brake=package.module:function\n")
    (tmp_path / "policy").mkdir()
    policy = str(network(tmp_path / "policy", NamedCart().spec(), (4,)))
    for command in (
        ("sample", name, *named, "--max-queries", "1"),
        ("evaluate", policy, *named, "--episodes", "2"),
        ("work", name, *named, "--once", "--folder", str(tmp_path / "work")),
    ):
        refused = on_server(*command)
        assert refused.code != 0
        assert "the limits name the fallback 'brake': expected --fallback brake=package.module:function" in refused.err
    assert json.loads(on_server("status", name, "--json").out)["ledger"]["total"] == 0
    assert on_server("sample", name, *named, *program_of, "--max-queries", "1").code == 0
    assert "the fallback acted" in on_server("evaluate", policy, *named, *program_of, "--episodes", "2").out
    deployed = on_server("deploy", policy, "--target", "c", "--out", str(tmp_path / "c"))
    assert deployed.code != 0
    assert "expected a fallback of terms, got the program 'brake'" in deployed.err


def test_sampling_counts_the_steps_of_the_fallback_that_are_not_in_the_ledger(
    on_server: Any, name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    diary, moving = tmp_path / "diary", ("--env", "support.limited:Cart")
    monkeypatch.setenv(DIARY, str(diary))
    on_server("register", name, *moving)
    report = json.loads(on_server("sample", name, *moving, "--max-queries", "2", "--json").out)
    taken = sum(line != "close" for line in diary.read_text().splitlines())
    assert report["fallback_steps"] == taken - report["steps"] > 0
    answers = iter([True])
    monkeypatch.setattr(typer, "confirm", lambda *_, **__: next(answers, None) or ended())
    monkeypatch.setattr("sys.stdin.isatty", lambda: True)
    assert "steps of the fallback, which are not in the ledger" in on_server("sample", name, *moving, "--approve").err
    waits = on_server("sample", name, *CART, "--max-queries", "1")
    assert "answered" in waits.out
    assert "fallback" not in waits.out


def ended() -> None:
    raise typer.Abort


def test_the_status_command_shows_how_many_real_steps_were_beyond_each_limit(on_server: Any, cart: str) -> None:
    assert "limit rail" not in on_server("status", cart).out
    assert on_server("sample", cart, *CART, "--max-queries", "2").code == 0
    shown = on_server("status", cart).out
    assert "limit rail: 0 of 3 real steps beyond it" in shown
    assert "margin 0.4" in shown


def test_violations_and_fallbacks_of_evaluations_are_in_ledger_policy_and_report(
    on_server: Any, cart: str, server_process: Any, tmp_path: Path
) -> None:
    policy = str(network(tmp_path, SPEC, (4,)))
    evaluated = json.loads(on_server("evaluate", policy, *CART, "--episodes", "3", "--surrogate", cart, "--json").out)
    counts = {key: evaluated["limits"][key] for key in ("violations", "fallbacks", "fallback_episodes")}
    assert counts["fallbacks"] > 0
    sentence = "0 of 3 episodes left a limit (95 % interval 0 to 71 %, allowed 1 %); the fallback acted in "
    sentence += f"{counts['fallbacks']} of 120 steps, in {counts['fallback_episodes']} of 3 episodes"
    with Api(server_process.url) as api:
        assert api.limits(cart) == [f"evaluations: {sentence}"]
        (stored,) = api.policies.list(cart)[0].evaluations
        assert stored.limits is not None
        assert counts.items() <= stored.limits.model_dump().items()
    assert f"evaluations: {sentence}" in on_server("status", cart).out
    assert f"declared starts, from seed 10000: {sentence}" in on_server("policy", "show", cart).out
    page = tmp_path / "report.html"
    assert on_server("report", cart, "--out", str(page)).code == 0
    assert f"evaluations: {sentence}" in page.read_text()
    assert f"Limits in real episodes: {sentence}." in page.read_text()


def test_the_evaluate_command_fails_if_too_many_episodes_left_a_limit(
    surrogym: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    spec = SPEC.model_copy(update={"limits": LIMITS.model_copy(update={"fallback": (Term.constant(1.0),)})})
    stopped = evaluate(
        lambda shown: np.ones((len(shown), 1)),
        lambda: open_episode("cart:Cart", spec, lambda: Cart(spec)),
        EvaluationSettings(10),
    )
    (tmp_path / "policy.zip").write_bytes(archive({}))
    (tmp_path / "policy.json").write_text(PolicyCard(spec=spec).model_dump_json())
    monkeypatch.setattr("surrogym_trainer.policies.files.load_policy", lambda *_, **__: None)
    monkeypatch.setattr("surrogym_trainer.evaluation.evaluator.evaluate", lambda *_: stopped)
    ended = surrogym("evaluate", "policy.zip", "--env", "support.limited:Cart", "--episodes", "10")
    assert ended.code == 1
    assert "2 of 2 episodes left a limit" in ended.out
