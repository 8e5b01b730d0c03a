"""A log on a server: all usable rows at no cost, nothing twice, and a model of them at once."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from support import reactor
from support.server import ServerProcess
from surrogym_client.errors import ServerUnreachable, UnknownSurrogate
from surrogym_client.surrogates.transfer import export_surrogate, import_surrogate
from surrogym_client.surrogates.waiting import wait_for_model
from surrogym_client.transport import Api
from surrogym_sampler.logs import UnusableLog, import_log, importing
from surrogym_shared.surrogate_file import SurrogateFile

ROWS = 60


@pytest.fixture
def log(tmp_path: Path) -> Path:
    return reactor.log(runs=3, length=20).write(tmp_path / "log.csv")


@pytest.fixture
def name(request: pytest.FixtureRequest) -> str:
    return request.node.name[:60].replace("[", "-").rstrip("]")


def test_importing_a_log_gives_a_model_without_a_sampler(server_process: ServerProcess, log: Path, name: str):
    imported = import_log(log, register=name, url=server_process.url)
    assert (imported.sent, imported.taken, imported.rejected_file) == (ROWS, ROWS, None)
    with Api(server_process.url) as api:
        view = wait_for_model(api, name, 120)
        kinds = {sample.purpose for sample in api.samples(name)}
    assert (view.phase, view.ledger.logged, view.ledger.total, view.budget) == ("from_log", ROWS, 0, 0)
    assert (view.queries.pending, view.samples, kinds) == (0, ROWS, {"logged"})


def test_importing_the_same_log_twice_changes_nothing(server_process: ServerProcess, log: Path, name: str):
    import_log(log, register=name, url=server_process.url)
    with Api(server_process.url) as api:
        first = wait_for_model(api, name, 120)
        again = import_log(log, register=name, url=server_process.url)
        assert (again.sent, again.duplicates, again.taken) == (ROWS, ROWS, 0)
        second = api.surrogate(name)
    assert (second.round, second.samples, second.phase) == (first.round, first.samples, "from_log")


def test_equal_steps_of_a_log_and_logs_with_equal_beginnings_are_all_stored(
    server_process: ServerProcess, tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch
):
    """A gauge of whole metres: 1,864 of 1,999 steps were dropped, because others had their numbers."""
    monkeypatch.setattr(importing, "BATCH", 25)
    for day, turns in (("monday", 40), ("tuesday", 45)):
        levels = [min(k // 10, turns // 10) for k in range(60)]
        lines = [f"{level},{1.5 if k < turns else -0.5},{-level}" for k, level in enumerate(levels)]
        (tmp_path / day).write_text("\n".join(["level,action_flow,reward", *lines]))
    spec = import_log(tmp_path / "tuesday").log.spec
    taken = [
        import_log(tmp_path / day, register=name, spec=spec, url=server_process.url).taken
        for day in ("monday", "tuesday", "monday", "tuesday")
    ]
    assert taken == [59, 59, 0, 0]
    with Api(server_process.url) as api:
        assert api.surrogate(name).samples == 2 * 59


def test_the_progress_of_a_repeated_import_reports_sent_steps(server_process: ServerProcess, log: Path, name: str):
    """The progress said that 60 of 60 steps were stored, and the result that none of them was new."""
    said: list[str] = []
    for _ in range(2):
        import_log(log, register=name, url=server_process.url, progress=lambda _, words: said.append(words))
    assert said[-1] == f"{ROWS} of {ROWS} steps sent"


def test_an_interrupted_import_can_be_resumed(
    server_process: ServerProcess, log: Path, name: str, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(importing, "BATCH", 25)

    def stop(share: float, words: str) -> None:
        if "25 of 60" in words:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        import_log(log, register=name, url=server_process.url, progress=stop)
    with Api(server_process.url) as api:
        assert (api.surrogate(name).samples, api.surrogate(name).phase) == (25, "collecting"), "no fit of half a log"
    imported = import_log(log, to=name, url=server_process.url)
    assert (imported.duplicates, imported.taken) == (25, 35)
    with Api(server_process.url) as api:
        assert wait_for_model(api, name, 120).samples == ROWS


def test_a_grown_log_adds_only_its_new_steps(server_process: ServerProcess, tmp_path: Path, name: str):
    whole = reactor.log(runs=3, length=20)
    early = reactor.Log(whole.heading, whole.rows[:40]).write(tmp_path / "early.csv")
    late = whole.write(tmp_path / "late.csv")
    spec = import_log(late).log.spec  # the ranges of all of it
    import_log(early, register=name, spec=spec, url=server_process.url)
    assert import_log(late, to=name, url=server_process.url).taken == 20


@pytest.mark.parametrize(("budget", "expected"), [(None, 5), (0, 0), (30, 30)])
def test_the_budget_option_of_import_replaces_that_of_the_specification(log: Path, budget: int | None, expected: int):
    drafted = import_log(log, budget=5).log.spec
    assert import_log(log, spec=drafted, budget=budget).log.spec.design.budget == expected


def test_a_surrogate_learned_from_a_log_can_be_exported_and_imported(
    server_process: ServerProcess, log: Path, name: str
):
    import_log(log, register=name, url=server_process.url)
    with Api(server_process.url) as api:
        before = wait_for_model(api, name, 120)
        file = SurrogateFile.from_bytes(export_surrogate(api, name).to_bytes())
        after = import_surrogate(api, file, f"{name}-2")
    assert (after.ledger.logged, after.ledger.total, after.budget_left) == (ROWS, 0, 0)
    assert (after.spec, after.model_version) == (before.spec, 1)


def test_a_design_continues_with_real_steps_after_a_log_import(server_process: ServerProcess, log: Path, name: str):
    spec = reactor.example().Reactor().spec()
    with Api(server_process.url) as api:
        before = api.create_surrogate(name, spec)
        import_log(log, to=name, url=server_process.url)
        view = wait_for_model(api, name, 120)
        asked = {query.purpose for query in api.queries(name)}
    assert view.budget_left + view.queries.pending == view.budget, "the log cost nothing"
    assert "adaptive" in asked
    assert view.queries.pending < before.queries.pending + 3, "initial queries that the log covers are withdrawn"


def test_log_rows_outside_the_surrogates_ranges_are_set_aside(server_process: ServerProcess, tmp_path: Path, name: str):
    with Api(server_process.url) as api:
        api.create_surrogate(name, reactor.example().Reactor().spec())
    damaged = reactor.log(runs=3, length=20).at(7, "action_coolant", "321").at(9, "temperature", "401")
    imported = import_log(damaged.write(tmp_path / "log.csv"), to=name, url=server_process.url)
    assert [line for line, _ in imported.log.rejected] == [9, 11]
    assert imported.sent == ROWS - 2


def test_rewards_in_another_unit_than_the_samples_are_refused(
    server_process: ServerProcess, log: Path, tmp_path: Path, name: str
):
    """States of another unit were refused, and rewards went into the model."""
    import_log(log, register=name, url=server_process.url)
    further = reactor.log(runs=6, length=20)
    column = further.heading.index("reward")
    for row in range(ROWS, 2 * ROWS):
        further = further.at(row, "reward", str(1_000 * float(further.rows[row][column])))
    new = reactor.Log(further.heading, further.rows[ROWS:]).write(tmp_path / "new.csv")
    with pytest.raises(UnusableLog, match=f"the samples of '{name}' have rewards of"):
        import_log(new, to=name, url=server_process.url)
    with Api(server_process.url) as api:
        assert api.surrogate(name).samples == ROWS


def test_importing_a_log_without_a_surrogate_name_sends_nothing(log: Path):
    imported = import_log(log, url="http://127.0.0.1:9")
    assert (imported.surrogate, imported.sent, len(imported.log.steps)) == (None, 0, ROWS)


def test_importing_to_an_unknown_surrogate_or_with_conflicting_options_is_refused(
    server_process: ServerProcess, log: Path
):
    with pytest.raises(UnknownSurrogate):
        import_log(log, to="nobody", url=server_process.url)
    with pytest.raises(ValueError, match="expected the argument 'to' alone"):
        import_log(log, register="a", to="b")


def test_the_import_command_drafts_registers_and_waits_for_the_model(
    server_process: ServerProcess, tmp_path: Path, name: str, capsys: pytest.CaptureFixture[str]
):
    from surrogym.cli import main

    path = reactor.log(runs=3, length=20).at(4, "temperature", "nan").write(tmp_path / "log.csv")
    common = ["import", str(path), "--register", name, "--draft", str(tmp_path / "spec.json"), "--wait", "120"]
    with pytest.raises(SystemExit) as ended:
        main([*common, "--json", "--quiet", "--server", server_process.url])
    assert not ended.value.code
    told = json.loads(capsys.readouterr().out)
    assert (told["rows"], told["sent"], told["view"]["phase"]) == (ROWS, ROWS - 1, "from_log")
    assert told["rejected"] == [{"line": 6, "reason": "temperature: not a number: nan"}]
    assert json.loads((tmp_path / "spec.json").read_text()) == told["spec"]
    with pytest.raises(SystemExit):
        main(["import", str(path), "--to", name, "--server", server_process.url])
    said = capsys.readouterr().out
    assert "1 row can't be used" in said
    assert f"{name}: 0 new logged steps, {ROWS - 1} were there before" in said
    assert "surrogym prior" not in said
    with pytest.raises(SystemExit):
        main(["import", str(path), "--register", f"{name}-2", "--server", server_process.url])
    advice = f"if a simulator made these rows, learn the machine beside them: surrogym prior MACHINE surrogate:{name}-2"
    assert advice in capsys.readouterr().out.splitlines()


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (["--name", "x"], "is a log: give --register NAME or --to NAME, not --name"),
        (["--register", "a", "--to", "b"], "expected --register or --to, got both"),
        (
            ["--to", "a", "--budget", "0"],
            "expected --budget without --to, whose surrogate has a budget, got both: surrogym change a --budget N",
        ),
        (
            ["--register", "my tank"],
            "name of the surrogate: expected 1 to 64 letters, digits, '.', '_' or '-'",
        ),
        (["--map", "nothing.toml"], "nothing.toml: No such file"),
    ],
)
def test_invalid_options_of_the_import_command_are_refused(
    log: Path, capsys: pytest.CaptureFixture[str], options: list[str], says: str
):
    from surrogym.cli import main

    with pytest.raises(SystemExit) as ended:
        main(["import", str(log), *options])
    assert ended.value.code == 1
    assert says in capsys.readouterr().err


def test_importing_to_an_unreachable_server_raises_an_error(log: Path, monkeypatch: pytest.MonkeyPatch):
    from surrogym_client.transport.connection import Retries

    monkeypatch.setattr("surrogym_sampler.logs.importing.Api", lambda *given: Api(*given, retries=Retries(seconds=0)))
    with pytest.raises(ServerUnreachable):
        import_log(log, register="a", url="http://127.0.0.1:9")


def test_the_command_recommended_after_a_log_check_repeats_its_options(
    log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    from surrogym.cli import main

    monkeypatch.chdir(tmp_path)
    Path("my map.json").write_text(json.dumps(reactor.MAPPING))
    given = ["import", "log.csv", "--map", "my map.json", "--budget", "5", "--rejected", "r.csv"]
    for more, kept in ([], ""), (["--draft", "spec.json"], " --spec spec.json"):
        with pytest.raises(SystemExit) as ended:
            main([*given, *more])
        assert not ended.value.code
        told = capsys.readouterr().out.splitlines()[-1]
        common = "nothing was stored; next: surrogym import log.csv --map 'my map.json' --budget 5 --rejected r.csv"
        assert told == f"{common}{kept} --register NAME"


def test_importing_a_log_without_reward_recommends_declaring_it(
    server_process: ServerProcess,
    tmp_path: Path,
    name: str,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
):
    """The last line led to a surrogate with a reward of 0, and to its training."""
    from surrogym.cli import main

    def last(*options: str) -> str:
        with pytest.raises(SystemExit) as ended:
            main(["import", "log.csv", *options])
        assert not ended.value.code
        return capsys.readouterr().out.splitlines()[-1]

    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("SURROGYM_URL", server_process.url)
    reactor.log(runs=3, length=20).without("reward").write(tmp_path / "log.csv")
    draft = "surrogym import log.csv --draft spec.json"
    assert last() == f"nothing was stored; the log has no reward, so declare it in the draft: {draft}"
    stored = f"{name} has a reward of 0, so there is nothing to train; declare the reward in a draft, and register it "
    assert last("--register", name) == f"{stored}under another name: {draft}"
    then = "declare the reward in spec.json, and then: surrogym import log.csv --spec spec.json --register NAME"
    assert last("--draft", "spec.json") == f"nothing was stored; next: {then}"
    assert last("--spec", "spec.json").endswith("next: surrogym import log.csv --spec spec.json --register NAME")
