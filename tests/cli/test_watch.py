"""``surrogym watch``: a plant that has changed costs the policy its trust; an unusable log changes nothing."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from support.saying import Said
from support.server import ServerProcess
from support.tank import HEADING, lines, watched_tank, write
from surrogym.cli.commands.renew import chain
from surrogym_client.errors import ServerUnreachable
from surrogym_client.surrogates.transfer import export_surrogate
from surrogym_client.transport import Api
from surrogym_client.transport.priors import PriorCalls
from surrogym_client.transport.steps import StepCalls
from surrogym_server.features.policies.routes import DRIFT_EXAMPLE
from surrogym_shared import wire
from surrogym_shared.wire.watching import MachineStep
from surrogym_trainer.policies.card import read_card
from surrogym_trainer.policies.pushing import push
from surrogym_trainer.watching.watcher import Watcher

Watch = Callable[..., Said]


@pytest.fixture(scope="module")
def tank(server_process: ServerProcess, tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    with watched_tank(server_process.url, tmp_path_factory.mktemp("tank")) as name:
        yield name


@pytest.fixture
def watch(on_server: Watch, tank: str) -> Watch:
    return lambda log, *options: on_server("watch", tank, str(log), "--policy", "production", *options)


@pytest.fixture
def policy(server_process: ServerProcess, tank: str) -> Callable[[], Any]:
    def get() -> Any:
        with Api(server_process.url) as api:
            return api.policies.get(tank, "production"), api.surrogate(tank).ledger.model_dump()

    return get


def test_watching_the_log_of_an_unchanged_plant_keeps_the_policy_trusted(
    watch: Watch, policy: Callable[[], Any], tmp_path: Path
):
    before = policy()
    said = watch(write(tmp_path / "log.csv", lines(1_500, seed=2)), "--json")
    assert said.code == 0, said.err
    result = json.loads(said.out)
    assert (result["compared"], result["drift"], result["trusted"]) == (1_499, None, None)
    assert policy() == before


@pytest.mark.parametrize(
    ("spoiled", "named"),
    [
        (lambda rows: [_with(row, 1, lambda level: 1_000 * level) for row in rows], ["level", "0.4504", "unit"]),
        (lambda rows: [_with(row, 0, lambda t: 0.5 * t) for row in rows], ["every 1 s", "0.5"]),
        (lambda rows: [row.rpartition(",")[0] for row in rows], ["columns"]),
        (lambda rows: rows[:1], ["1 row"]),
    ],
    ids=["other units", "another period", "no reward", "one row"],
)
def test_the_watch_command_refuses_an_unusable_log_and_changes_nothing(
    watch: Watch, policy: Callable[[], Any], tmp_path: Path, spoiled: Callable[[list[str]], list[str]], named: list[str]
):
    before = policy()
    log = write(tmp_path / "log.csv", spoiled(lines(300, seed=3)))
    content = log.read_bytes()
    said = watch(log)
    assert said.code == 1
    assert not [words for words in named if words not in said.err], said.err
    assert "Traceback" not in said.err
    assert policy() == before
    assert log.read_bytes() == content
    assert list(tmp_path.iterdir()) == [log]


def test_the_watch_command_reports_and_skips_gaps_and_unordered_rows(watch: Watch, tmp_path: Path):
    rows = lines(400, seed=4)
    rows[200], rows[300] = rows[300], _with(rows[300], 1, lambda _: float("nan"))
    said = watch(write(tmp_path / "log.csv", [*rows[:100], *rows[110:]]), "--json")
    assert said.code == 0, said.err
    result = json.loads(said.out)
    assert any(note.startswith("5 rows have no next state") for note in result["notes"]), result["notes"]
    assert {one["line"] for one in result["rejected"]} >= {292}
    assert 380 < result["compared"] < 389


def test_drift_found_by_watch_makes_the_policy_untrusted_and_is_shown_everywhere(
    watch: Watch, on_server: Watch, policy: Callable[[], Any], tank: str, tmp_path: Path
):
    log = write(tmp_path / "log.csv", lines(400, seed=5, worn_from=200))
    said = watch(log)
    assert said.code == 1, said.err
    shown, as_json = on_server("policy", f"{tank}@production"), watch(log, "--json")
    found = json.loads(as_json.out)["drift"]
    assert found["output"] == "level"
    assert 200 < found["line"] <= 240
    assert found["compared"] == found["line"] - 1
    assert found["region"]["name"] in ("level", "action 0")
    assert f"line {found['line']}" in said.out
    now, ledger = policy()
    assert (now.trusted, ledger["logged"]) == (False, 79)
    for text in (now.reason, shown.out, on_server("status", tank).out):
        assert "drift: level is" in text


def test_the_watch_command_shows_drift_although_the_server_is_unreachable(
    watch: Watch, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
):
    def gone(*_: object) -> None:
        raise ServerUnreachable("the server is gone")

    monkeypatch.setattr("surrogym_trainer.watching.watcher.Watcher.withdraw", gone)
    said = watch(write(tmp_path / "log.csv", lines(300, seed=5, worn_from=150)))
    assert said.code == 1
    assert "level is" in said.err
    assert "the server is gone" in said.err


def test_the_watch_command_rejects_rows_after_a_change_of_unit_instead_of_reporting_drift(
    watch: Watch, policy: Callable[[], Any], tmp_path: Path
):
    before, rows = policy(), lines(300, seed=9)
    in_percent = [_with(row, 1, lambda level: 100 * level) for row in rows[250:]]
    said = watch(write(tmp_path / "log.csv", [*rows[:250], *in_percent]), "--json")
    assert said.code == 0, said.err
    assert said.json["compared"] == 249
    assert [one["line"] for one in said.json["rejected"]] == list(range(251, 301))
    assert policy() == before


def test_the_watch_command_distinguishes_a_log_of_another_machine_from_drift(watch: Watch, tmp_path: Path):
    said = [watch(write(tmp_path / "log.csv", lines(300, seed=5, worn_from=at))) for at in (0, 200)]
    assert [one.code for one in said] == [1, 1]
    assert ["another machine" in one.out for one in said] == [True, False]


def test_the_watch_command_with_follow_reads_a_growing_log_until_drift_is_found(
    watch: Watch, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
):
    """Lines come in pieces, and a half-written line is no row yet."""
    monkeypatch.setattr("surrogym_trainer.watching.logs.LOOK_SECONDS", 0.02)
    monkeypatch.setattr("surrogym_trainer.watching.logs.LATEST", 20)
    log = tmp_path / "log.csv"
    text = "\n".join([HEADING, *lines(300, seed=6, worn_from=150)]) + "\n"
    pieces = [text[i : i + 400] for i in range(0, len(text), 400)]
    log.write_text(pieces[0], encoding="utf-8")

    def grow() -> None:
        for piece in pieces[1:]:
            time.sleep(0.05)
            with log.open("a", encoding="utf-8") as opened:
                opened.write(piece)

    writer = threading.Thread(target=grow)
    writer.start()
    try:
        followed = watch(log, "--follow", "--json")
    finally:
        writer.join()
    at_once = watch(log, "--json")
    assert (followed.code, at_once.code) == (1, 1)
    assert followed.json["rejected"] == []
    assert followed.json["drift"] == at_once.json["drift"]


def test_the_watch_command_reads_a_log_from_standard_input(
    watch: Watch, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
):
    """The last line may lack its end."""
    log = write(tmp_path / "log.csv", lines(300, seed=6, worn_from=150))
    log.write_text(log.read_text(encoding="utf-8").rstrip("\n"), encoding="utf-8")
    at_once = watch(log, "--json")
    with log.open(encoding="utf-8") as opened:
        monkeypatch.setattr("sys.stdin", opened)
        piped = watch("-", "--json")
    assert (piped.code, piped.json["drift"]) == (1, at_once.json["drift"])
    with (tmp_path / "empty.csv").open("w+", encoding="utf-8") as opened:
        opened.write(HEADING)
        opened.seek(0)
        monkeypatch.setattr("sys.stdin", opened)
        said = watch("-")
    assert said.code == 1
    assert "got none" in said.err


def test_the_watch_command_finds_drift_in_steps_that_the_machine_posts(
    on_server: Watch, server_process: ServerProcess, policy: Callable[[], Any], tank: str, tmp_path: Path
):
    """The same as in a log of these steps. They are posted in batches, one of them twice, and no model learns them."""
    ledger = policy()[1]
    options = ("--policy", "production", "--json")
    said = on_server("watch", tank, *options)
    assert said.code == 1
    assert f"/v1/surrogates/{tank}/steps" in said.err
    rows = lines(300, seed=11, worn_from=150)
    steps = _steps(rows)
    with Api(server_process.url) as api:
        calls, machine = StepCalls(api.connection), api.surrogate(tank).spec.environment
        for first in (0, 60, 60, 120, 180, 240):
            calls.add(tank, machine, "pump", first, steps[first : first + 60], period=1.0)
    posted = on_server("watch", tank, *options, "--follow")
    again = on_server("watch", tank, "--policy", "production")
    logged = on_server("watch", tank, str(write(tmp_path / "log.csv", rows)), *options)
    assert (posted.code, logged.code) == (1, 1)
    assert posted.json["compared"] == logged.json["compared"]
    assert posted.json["drift"] == {**logged.json["drift"], "line": logged.json["drift"]["line"] - 2}
    assert policy()[1] == ledger
    assert again.code == 1
    assert "UTC, when drift was reported, got none" in again.err


def test_posted_steps_are_compared_from_the_latest_confirmation_of_the_promise_on(
    on_server: Watch, server_process: ServerProcess, policy: Callable[[], Any], tank: str
):
    """After trust was regained, the command ended at the same old drift again."""
    watch = ("watch", tank, "--policy", "production")
    worn, sound = _steps(lines(200, seed=21, worn_from=100)), _steps(lines(200, seed=22))
    kept = wire.AddEvaluation(first_seed=1, returns=[-1.0] * 30, lengths=[9] * 30, idempotency_key="after the repair")
    with Api(server_process.url) as api:
        calls, machine = StepCalls(api.connection), api.surrogate(tank).spec.environment
        calls.add(tank, machine, "repaired", 0, worn)
        found = on_server(*watch)
        assert "drift, found in stream 'repaired', step" in found.out, found.err
        assert api.policies.evaluate(tank, policy()[0].version, kept).promise_kept
        calls.add(tank, machine, "repaired", len(worn), sound)
    said = on_server(*watch)
    assert said.code == 0, said.out
    assert f"no drift in {len(sound)} real steps" in said.out
    assert "compares the steps posted since 20" in said.err
    assert "UTC, when real episodes kept the promise" in said.err
    assert policy()[0].trusted


def test_the_watch_command_with_follow_refuses_a_log_that_became_shorter(
    watch: Watch, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
):
    monkeypatch.setattr("surrogym_trainer.watching.logs.LOOK_SECONDS", 0.0)
    log = write(tmp_path / "log.csv", lines(200, seed=7))
    threading.Timer(1.0, lambda: write(log, lines(20, seed=7))).start()
    said = watch(log, "--follow")
    assert said.code == 1
    assert "grow" in said.err


def test_the_watch_command_refuses_a_policy_of_another_surrogate(on_server: Watch, tank: str, tmp_path: Path):
    log = write(tmp_path / "log.csv", lines(50, seed=8))
    said = on_server("watch", tank, str(log), "--policy", "other@production")
    assert said.code == 1
    assert f"expected a policy of '{tank}', got 'other@production'" in said.err


@pytest.fixture
def second(server_process: ServerProcess, tank: str) -> Iterator[Callable[[bool], str]]:
    """Makes a surrogate with the name of a renewal of the tank, whose prior is the tank or which has none. Its policy
    is in production, and after a renewal a copy of this policy is the latest of the tank's."""
    name = f"{tank}-2"
    with Api(server_process.url) as api:

        def make(renewed: bool) -> str:
            api.create_surrogate(name, api.surrogate(tank).spec)
            if renewed:
                PriorCalls(api.connection).put(name, export_surrogate(api, tank).to_bytes())
            promise = wire.PolicyPromise(median=-2, low=-3, high=-1)
            card = wire.PushedCard(surrogate=name, spec=api.surrogate(tank).spec, promise=promise, trusted=True)
            for place in (name, tank)[: 1 + renewed]:
                api.policies.push(place, card, [], "zip", api.policies.file(tank, 1, "zip"))
            api.policies.put_alias(name, "production", 1)
            return name

        yield make
        api.delete_surrogate(name)
        for policy in api.policies.list(tank)[:-1]:
            api.policies.delete(tank, policy.version)


@pytest.mark.parametrize("which", ["production", "latest"])
def test_the_watch_command_refuses_a_renewed_policy_at_its_old_surrogate(
    watch: Watch,
    policy: Callable[[], Any],
    second: Callable[[bool], str],
    tank: str,
    server_process: ServerProcess,
    tmp_path: Path,
    which: str,
):
    """The old model differs from the machine for which the new policy was trained. An older renewed version was
    compared with it."""
    renewed, before = second(True), policy()
    with Api(server_process.url) as api:
        copy = api.policies.get(tank, "latest").version
        if which == "production":
            api.policies.put_alias(tank, which, copy)
        said = watch(write(tmp_path / "log.csv", lines(300, seed=5, worn_from=150)), "--policy", which)
        api.policies.put_alias(tank, "production", 1)
    assert said.code == 1
    assert f"surrogym watch {renewed} --policy {'production' if which == 'production' else 1}" in said.err
    assert policy() == before


def test_a_copied_policy_has_the_trust_of_the_policy_of_its_training(
    on_server: Watch, second: Callable[[bool], str], tank: str, server_process: ServerProcess, tmp_path: Path
):
    """A drift of a renewed policy was stored with the new surrogate only, and controllers ask the old one."""
    renewed = second(True)
    with Api(server_process.url) as api:
        copy = api.policies.get(tank, "latest")
        assert (copy.trusted, copy.origin) == (True, f"{renewed}@1")
        api.connection.send("POST", f"/v1/surrogates/{renewed}/policies/1/drifts", json.dumps(DRIFT_EXAMPLE).encode())
        drifted = api.policies.get(tank, "latest")
        assert (drifted.trusted, drifted.reason) == (False, api.policies.get(renewed, 1).reason)
        assert "drift: " in on_server("policy", f"{tank}@latest").out
        assert on_server("policy", "get", f"{tank}@latest", "--out", str(tmp_path / "got.zip")).code == 0
        card = read_card(tmp_path / "got.zip")
        assert (card.surrogate, card.trusted) == (renewed, False)
        deployed = on_server("deploy", f"{tank}@latest", "--target", "c", "--out", str(tmp_path / "c"))
        assert "not trusted" in deployed.out, deployed.err
        assert (tmp_path / "c" / f"{tank.replace('-', '_')}_controller.c").exists()
        assert push(api, tmp_path / "got.zip").policy.version == 1
        kept = wire.AddEvaluation(first_seed=1, returns=[-2.0] * 30, lengths=[9] * 30, idempotency_key="kept")
        stored = api.policies.evaluate(renewed, 1, kept)
        again = api.policies.get(tank, "latest")
        assert (again.trusted, again.drifted_at, [one.id for one in again.evaluations]) == (True, None, [stored.id])
        assert api.policies.evaluation(tank, copy.version, stored.id).returns == kept.returns
        assert api.policies.get(tank, 1).origin is None


def test_another_surrogate_with_the_name_of_a_renewal_is_none(
    watch: Watch, tank: str, server_process: ServerProcess, second: Callable[[bool], str], tmp_path: Path
):
    second(False)
    assert watch(write(tmp_path / "log.csv", lines(300, seed=2))).code == 0
    with Api(server_process.url) as api:
        base, target = chain(api, tank, "production")
    assert (base.name, target) == (tank, f"{tank}-3")


def test_the_watch_command_says_that_the_alias_has_moved_meanwhile(
    watch: Watch, tank: str, server_process: ServerProcess, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
):
    take = Watcher.take
    with Api(server_process.url) as api:
        card = wire.PushedCard(spec=api.surrogate(tank).spec, promise=None, trusted=None, reason="not audited")
        later = api.policies.push(tank, card, [], "zip", api.policies.file(tank, 1, "zip")).version

        def moved(self: Watcher, steps: Any) -> Any:
            api.policies.put_alias(tank, "production", later)
            return take(self, steps)

        monkeypatch.setattr(Watcher, "take", moved)
        said = watch(write(tmp_path / "log.csv", lines(300, seed=12, worn_from=150)))
        api.policies.put_alias(tank, "production", 1)
        api.policies.delete(tank, later)
    assert said.code == 1
    assert f"{tank}@1 is not trusted from now on" in said.out
    assert f"{tank}@production leads to version {later} by now" in said.out


def test_the_watch_command_says_that_a_policy_is_still_trusted_after_a_repeated_report(
    watch: Watch, policy: Callable[[], Any], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
):
    """Real episodes have confirmed the promise since the same drift was reported."""
    confirmed = policy()[0].model_copy(update={"trusted": True})
    monkeypatch.setattr(Watcher, "withdraw", lambda *_: confirmed)
    said = watch(write(tmp_path / "log.csv", lines(300, seed=5, worn_from=150)))
    assert said.code == 1
    assert "is still trusted" in said.out
    assert "not trusted" not in said.out


@pytest.mark.parametrize(("name", "which"), [("nobody", "1"), ("", "staging"), ("", "7")])
def test_the_watch_command_names_an_unknown_surrogate_or_policy(
    on_server: Watch, tank: str, tmp_path: Path, name: str, which: str
):
    log = write(tmp_path / "log.csv", lines(50, seed=8))
    said = on_server("watch", name or tank, str(log), "--policy", which)
    assert said.code == 1
    assert (name or which) in said.err


def _steps(rows: list[str]) -> list[MachineStep]:
    """The steps of a log, as a machine posts them."""
    cells = [[float(cell) for cell in row.split(",")] for row in rows]
    return [
        MachineStep(coordinates=[q], action=[u], next_coordinates=[after[1]], reward=paid)
        for (_, q, u, paid), after in pairwise(cells)
    ]


def _with(row: str, column: int, change: Callable[[float], float]) -> str:
    cells = row.split(",")
    cells[column] = f"{change(float(cells[column])):.6f}"
    return ",".join(cells)
