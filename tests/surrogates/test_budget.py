"""What rounds of real queries may cost is said before they begin, and refused where the owner's budget is too small."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from uuid import uuid4

import pytest

from support.server import ServerProcess, running_server
from surrogym.cli import main
from surrogym_client.errors import BeyondBudget
from surrogym_client.surrogates.waiting import BudgetTooSmall, words_of_rounds
from surrogym_client.transport import Api
from surrogym_sampler.original.classic import pendulum
from surrogym_shared.spec import Design

TOKENS = {role: f"the-token-to-{role}" for role in ("train", "admin")}


@pytest.fixture(scope="module")
def guarded(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ServerProcess]:
    tokens = ",".join(f"{role}:{token}" for role, token in TOKENS.items())
    with running_server(tmp_path_factory.mktemp("budget"), SURROGYM_TOKENS=tokens) as server:
        yield server


@pytest.fixture
def owned(guarded: ServerProcess) -> str:
    """A surrogate with a budget of 12, of which 4 are asked for."""
    name = f"owned-{uuid4().hex[:8]}"
    with Api(guarded.url, TOKENS["admin"]) as api:
        api.create_surrogate(name, pendulum().model_copy(update={"design": Design(initial=4, budget=12)}))
    return name


def test_the_real_steps_of_training_rounds_within_the_budget_are_announced(guarded: ServerProcess, owned: str) -> None:
    with Api(guarded.url, TOKENS["train"]) as api:
        words = words_of_rounds(api, owned, queries=4, rounds=2)
    assert words == f"up to 8 more real steps (2 rounds of 4); the budget of {owned!r} has 8 of 12 real steps left"


def test_training_rounds_of_a_ready_design_take_real_steps_only_after_a_failed_audit(
    guarded: ServerProcess, monkeypatch: pytest.MonkeyPatch
) -> None:
    with Api(guarded.url, TOKENS["admin"]) as api:
        name = "ready"
        api.create_surrogate(name, pendulum().model_copy(update={"design": Design(initial=4, budget=12)}))
        view = api.surrogate(name).model_copy(update={"phase": "ready"})
        monkeypatch.setattr(api, "surrogate", lambda _: view)
        assert words_of_rounds(api, name, queries=3, rounds=3).endswith("no real steps, unless an audit fails")


def test_training_rounds_that_raise_the_budget_of_real_steps_require_an_admin_token(
    guarded: ServerProcess, owned: str
) -> None:
    with Api(guarded.url, TOKENS["train"]) as api, pytest.raises(BudgetTooSmall, match=rf"{owned} --budget 13\b"):
        words_of_rounds(api, owned, queries=3, rounds=3)
    with Api(guarded.url, TOKENS["admin"]) as api:
        assert words_of_rounds(api, owned, queries=3, rounds=3).endswith("left, and will be raised to at most 13")


def test_the_server_refuses_improve_beyond_the_budget_and_changes_nothing(guarded: ServerProcess, owned: str) -> None:
    with Api(guarded.url, TOKENS["train"]) as api:
        with pytest.raises(BeyondBudget, match="at most 8 more real steps"):
            api.improve(owned, 10_000)
        assert (api.surrogate(owned).budget, api.surrogate(owned).budget_left) == (12, 8)
        assert (api.improve(owned, 8).budget_raised_by, api.surrogate(owned).budget_left) == (0, 0)
    with Api(guarded.url, TOKENS["admin"]) as api:
        assert (api.improve(owned, 2).budget_raised_by, api.surrogate(owned).budget) == (2, 14)


@pytest.mark.parametrize(
    "command",
    [("improve", "--queries", "10000"), ("train", "--improve", "5", "--rounds", "3")],
    ids=["improve", "train"],
)
def test_commands_refuse_steps_beyond_the_budget_in_one_sentence(
    guarded: ServerProcess,
    owned: str,
    command: tuple[str, ...],
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("SURROGYM_TOKEN", TOKENS["train"])
    monkeypatch.setattr("surrogym.cli.commands.train._trainable", lambda *_, **__: (pendulum(), guarded.url))
    with pytest.raises(SystemExit) as ended:
        main([command[0], owned, *command[1:], "--server", guarded.url])
    said = capsys.readouterr().err
    assert ended.value.code == 1
    assert said.startswith("error: ")
    assert said.count("\n") == 1
    assert f"surrogym change {owned} --budget" in said
    assert list(tmp_path.iterdir()) == []
