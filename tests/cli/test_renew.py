"""``surrogym renew``: a policy of a changed plant replaces the old one only if an audit and real episodes agree."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from support.levitation import PENDULUM, Swing
from support.rated import RATED, RatedRail
from support.saying import Said
from support.server import ServerProcess
from surrogym.cli.commands.policy import stored_card
from surrogym.cli.commands.renew import _Renewal
from surrogym_client.surrogates.waiting import wait_for_design
from surrogym_client.transport import Api, HttpSurrogate
from surrogym_sampler.queries.settings import SamplerSettings
from surrogym_sampler.queries.worker import Sampler
from surrogym_shared.spec import Design
from surrogym_trainer.policies.card import write_card
from surrogym_trainer.policies.evidence import Promise
from surrogym_trainer.policies.pushing import as_pushed, push
from surrogym_trainer.training import TrainResult, TrainSettings, train
from surrogym_trainer.training.audited import AuditedTraining
from surrogym_trainer.training.cards import card_of
from surrogym_trainer.training.fast_ppo.search import FastPpo
from surrogym_trainer.training.handover import Handover

pytestmark = pytest.mark.timeout(900)  # on a machine that others use as well
Renew = Callable[..., Said]
REAL_STEPS = 32


@pytest.fixture(scope="module")
def trained(server_process: ServerProcess, tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """A surrogate of the pendulum before its change, with a policy in production."""
    name, path = "swing", tmp_path_factory.mktemp("swing") / "old.zip"
    spec = PENDULUM.spec.model_copy(update={"design": Design(initial=REAL_STEPS, budget=REAL_STEPS)})
    with Api(server_process.url) as api, HttpSurrogate(server_process.url, name) as port:
        api.create_surrogate(name, spec)
        Sampler(api, name, Swing(), SamplerSettings(until_done=True, wait_seconds=1.0)).run()
        view = wait_for_design(api, name, 120)
        result = train(port, path, TrainSettings(algorithm="FASTPPO"))
        write_card(path, card_of(result, surrogate=name, spec=view.spec, url=api.url, seed=0, curve=()))
        push(api, path, name)
        api.policies.put_alias(name, "production", 1)
        yield name
        api.delete_surrogate(name)


@pytest.fixture
def renew(
    on_server: Renew, trained: str, server_process: ServerProcess, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Renew]:
    """Runs the command. Its trainings are short, because the old policy is a good start."""
    monkeypatch.setattr(FastPpo, "suggested_steps", 60_000)

    def run(plant: str, *options: str) -> Said:
        out = str(tmp_path / "new.zip")
        asked = ("--policy", f"{trained}@production", "--env", f"support.levitation:{plant}", "--out", out)
        return on_server("renew", trained, *asked, *options)

    yield run
    with Api(server_process.url) as api:
        api.policies.put_alias(trained, "production", 1)
        for policy in api.policies.list(trained)[:-1]:
            api.policies.delete(trained, policy.version)
        for one in api.surrogates():
            if one.name.startswith(f"{trained}-"):
                api.delete_surrogate(one.name)


def led_to(server_process: ServerProcess, name: str) -> int:
    with Api(server_process.url) as api:
        return api.policies.get(name, "production").version


def test_a_renewed_policy_replaces_the_old_one_with_a_quarter_of_the_real_steps(
    renew: Renew, on_server: Renew, trained: str, server_process: ServerProcess
):
    """Episodes in the changed environment judge the new promise, also for the copy that controllers ask for."""
    said = renew("HeavySwing", "--json")
    assert said.code == 0, said.err
    found = said.json
    assert (found["surrogate"], found["prior"], found["renewed"]) == ("swing-2", "swing", True)
    assert found["real_steps"]["total"] <= REAL_STEPS // 4
    assert led_to(server_process, trained) == found["alias"]["version"] > 1
    with Api(server_process.url) as api:
        card = api.policies.get("swing-2", "production")
        assert (card.trusted, card.settings["start_from"]) == (True, "swing@1")
        assert api.surrogate("swing-2").ledger.evaluation > 0
        assert api.policies.get("swing", "production").origin == f"swing-2@{card.version}"
        evaluated = on_server("evaluate", "new.zip", "--env", "support.levitation:HeavySwing", "--episodes", "30")
        assert evaluated.code == 0, evaluated.err
        again = on_server("renew", "swing-2", "--policy", "production", "--env", "support.levitation:HeavySwing")
        assert again.code == 1
        assert "next: surrogym renew swing --policy swing@production" in again.err
        now = api.policies.get("swing", "production")
        assert [(one.own, one.promise_kept) for one in now.evaluations] == [(True, True)]


def test_the_alias_goes_back_if_real_episodes_contradict_the_new_promise(
    renew: Renew, trained: str, server_process: ServerProcess
):
    said = renew("TiredSwing")
    assert said.code == 1
    assert "leads to version 1 again, because real episodes contradict the new promise" in said.out, said.out + said.err
    assert led_to(server_process, trained) == 1
    with Api(server_process.url) as api:
        assert [one.aliases for one in api.policies.list("swing-2")] == [[]]
        assert api.surrogate("swing-2").ledger.evaluation > 0


@pytest.fixture
def handed_over(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Replaces training and audit by a short training, and a judgement of the caller's choice."""

    def replaced(*, trusted: bool) -> None:
        def short(self: AuditedTraining) -> tuple[TrainResult, Handover]:
            settings = replace(self.settings, total_steps=4_096, prolong=False)
            promise = Promise(median=80.0, low=78.0, high=82.0, functions=32, episodes=8)
            return train(self.port, self.out, settings), Handover(promise, None, trusted, "so it was said")

        monkeypatch.setattr(AuditedTraining, "train", short)

    return replaced


def test_a_policy_that_is_not_trusted_never_gets_the_alias(
    renew: Renew, trained: str, server_process: ServerProcess, handed_over: Callable[..., None]
):
    handed_over(trusted=False)
    said = renew("HeavySwing")
    assert said.code == 1
    assert "leads to version 1 as before, because the new policy is not trusted" in said.out
    with Api(server_process.url) as api:
        assert [one.version for one in api.policies.list(trained)] == [1]


def test_a_renewal_that_was_not_trusted_continues_with_a_larger_budget_in_the_same_environment(
    renew: Renew, trained: str, server_process: ServerProcess, handed_over: Callable[..., None]
):
    """Both were refused, with the advice to register the surrogate under another name."""
    handed_over(trusted=False)
    first = renew("HeavySwing", "--budget", "4", "--json").json["real_steps"]["total"]
    more = renew("HeavySwing", "--budget", "12", "--json")
    assert more.code == 1
    assert first <= 4 < more.json["real_steps"]["total"] <= 12, more.err
    assert renew("HeavySwing", "--json").json["real_steps"] == more.json["real_steps"]
    other = renew("TiredSwing")
    assert other.code == 1
    assert "expected 'support.levitation:HeavySwing', with which an earlier run began 'swing-2'" in other.err
    with Api(server_process.url) as api:
        assert api.surrogate("swing-2").budget == 12


def test_a_training_does_not_begin_with_a_policy_that_fails_in_the_new_model(
    renew: Renew, trained: str, server_process: ServerProcess, handed_over: Callable[..., None], tmp_path: Path
):
    """A ball that is 30 % heavier falls. A training that began with its old policy ended at 29 in place of 143."""
    with Api(server_process.url) as api:
        card = stored_card(api, trained, "1")[2].model_copy(update={"imagined_return": 800.0})
        (tmp_path / "failing.zip").write_bytes(api.policies.file(trained, 1, "zip"))
        write_card(tmp_path / "failing.zip", card)
        failing = push(api, tmp_path / "failing.zip", trained).policy.version
        foreign = as_pushed(card.model_copy(update={"algorithm": "of another program"}))
        other = api.policies.push(trained, foreign, [], "onnx", b"\x08 no model").version
        handed_over(trusted=False)
        for version, start in ((1, f"{trained}@1"), (failing, None), (other, None)):
            api.policies.put_alias(trained, "production", version)
            assert renew("HeavySwing").code == 1
            assert api.policies.get(f"{trained}-2").settings["start_from"] == start


@pytest.mark.parametrize("where", ["train", "by_episodes"])
def test_an_interrupted_renewal_leaves_the_alias_and_continues_with_the_same_surrogate(
    renew: Renew,
    trained: str,
    server_process: ServerProcess,
    handed_over: Callable[..., None],
    monkeypatch: pytest.MonkeyPatch,
    where: str,
):
    def stopped(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt

    handed_over(trusted=True)
    with monkeypatch.context() as during:
        place = {"train": "surrogym_trainer.training.audited.AuditedTraining.train"}
        during.setattr(place.get(where, "surrogym.cli.commands.audit.by_episodes"), stopped)
        said = renew("HeavySwing")
    assert said.code == 130
    assert "swing@production leads to version 1 as before" in said.err
    assert led_to(server_process, trained) == 1
    with Api(server_process.url) as api:
        taken = api.surrogate("swing-2").ledger.total
    agreed = Handover(None, None, True, "it was said again")
    monkeypatch.setattr("surrogym.cli.commands.audit.by_episodes", lambda *_, **__: agreed)
    first, second = renew("HeavySwing", "--json").json, renew("HeavySwing", "--json").json
    assert (first["surrogate"], first["prior"], first["real_steps"]["total"]) == ("swing-2", "swing", taken)
    assert (second["surrogate"], second["prior"], second["renewed"]) == ("swing-3", "swing-2", True)
    assert led_to(server_process, trained) == second["alias"]["version"]


@pytest.mark.parametrize("where", ["training", "episodes"])
def test_an_alias_that_somebody_else_moves_during_a_renewal_stays_there(
    renew: Renew,
    trained: str,
    server_process: ServerProcess,
    handed_over: Callable[..., None],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    where: str,
):
    """The command moved it on to its own policy, or back to the old one."""
    handed_over(trusted=True)
    with Api(server_process.url) as api:
        card = stored_card(api, trained, "1")[2].model_copy(update={"imagined_return": 1.0})
        (tmp_path / "by hand.zip").write_bytes(api.policies.file(trained, 1, "zip"))
        write_card(tmp_path / "by hand.zip", card)
        by_hand = push(api, tmp_path / "by hand.zip", trained).policy.version

        def moving(*_: Any, **__: Any) -> Handover:
            api.policies.put_alias(trained, "production", by_hand)
            return Handover(None, None, False, "so the episodes say")

        if where == "training":
            short = _Renewal.train
            monkeypatch.setattr(_Renewal, "train", lambda *given: (short(*given), moving())[0])
        monkeypatch.setattr("surrogym.cli.commands.audit.by_episodes", moving)
        said = renew("HeavySwing")
    assert said.code == 1
    assert f"got version {by_hand}: somebody else has moved it meanwhile, and it stays there" in said.err
    assert "the new policy is swing-2@1" in said.err
    assert led_to(server_process, trained) == by_hand


@pytest.mark.parametrize("agree", [True, False])
def test_a_renewal_that_was_killed_during_its_episodes_continues_with_them(
    renew: Renew,
    trained: str,
    server_process: ServerProcess,
    handed_over: Callable[..., None],
    monkeypatch: pytest.MonkeyPatch,
    agree: bool,
):
    """The alias stays with the unconfirmed policy after kill -9. The next run took this policy for the old one."""

    def stopped(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt

    handed_over(trusted=True)
    with monkeypatch.context() as during:
        during.setattr("surrogym.cli.commands.audit.by_episodes", stopped)
        assert renew("HeavySwing").code == 130
    monkeypatch.setattr(AuditedTraining, "train", stopped)
    judged = Handover(None, None, agree, "so the episodes say")
    monkeypatch.setattr("surrogym.cli.commands.audit.by_episodes", lambda *_, **__: judged)
    with Api(server_process.url) as api:
        unconfirmed, ledger = api.policies.get(trained, "latest").version, api.surrogate("swing-2").ledger
        api.policies.put_alias(trained, "production", unconfirmed)
        said = renew("HeavySwing")
        assert said.code == (0 if agree else 1), said.err
        assert "swing-2@1 continues with 3 episodes" in said.err
        assert api.surrogate("swing-2").ledger == ledger
        assert len(api.policies.list(trained)) == 2
    assert led_to(server_process, trained) == (unconfirmed if agree else 1)


def test_a_surrogate_with_lags_is_renewed(
    on_server: Renew,
    server_process: ServerProcess,
    handed_over: Callable[..., None],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    name: str,
):
    """The documentation denied it, but only a simulator can't be the prior: it can't be set to a past."""
    handed_over(trusted=True)
    agreed = Handover(None, None, True, "so it was said")
    monkeypatch.setattr("surrogym.cli.commands.audit.by_episodes", lambda *_, **__: agreed)
    spec = RATED.model_copy(update={"design": Design(initial=12, budget=12)})
    with Api(server_process.url) as api, HttpSurrogate(server_process.url, name) as port:
        api.create_surrogate(name, spec)
        Sampler(api, name, RatedRail(), SamplerSettings(until_done=True, wait_seconds=1.0)).run()
        wait_for_design(api, name, 120)
        train(port, tmp_path / "old.zip", TrainSettings(algorithm="FASTPPO", total_steps=4_096, prolong=False))
        push(api, tmp_path / "old.zip", name)
        api.policies.put_alias(name, "production", 1)
        options = ("--policy", "production", "--env", "support.rated:RatedRail", "--json")
        said = on_server("renew", name, *options, "--out", str(tmp_path / "new.zip"))
        for one in (name, f"{name}-2"):
            api.delete_surrogate(one)
    assert said.code == 0, said.err
    assert (said.json["prior"], said.json["renewed"]) == (name, True)


@pytest.mark.parametrize(
    ("options", "named"),
    [
        (("--policy", "1"), ["expected an alias", "got '1'"]),
        (("--policy", "other@production"), ["expected a policy of 'swing'", "got 'other@production'"]),
        (("--policy", "staging"), ["staging"]),
        (("--policy", "production"), ["--env"]),
        (("--policy", "production", "--env", "support.levitation:Nothing"), ["Nothing"]),
        (("--policy", "production", "--env", "support.rated:RatedRail"), ["does not fit surrogate 'swing'"]),
    ],
)
def test_an_unusable_renewal_is_refused_before_it_changes_anything(
    on_server: Renew, trained: str, server_process: ServerProcess, options: tuple[str, ...], named: list[str]
):
    said = on_server("renew", trained, *options)
    assert said.code == 1
    assert not [words for words in named if words not in said.err], said.err
    with Api(server_process.url) as api:
        assert not [one.name for one in api.surrogates() if one.name.startswith("swing-")]
    assert led_to(server_process, trained) == 1
