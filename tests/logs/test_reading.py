"""Files to transitions: the same steps in every format, next states by order, and rows set aside with their reason."""

from __future__ import annotations

import csv
import json
import sys
import warnings
from pathlib import Path

import gymnasium
import numpy as np
import pytest

from support import reactor
from surrogym_sampler.logs import ReadLog, UnusableLog, read_log
from surrogym_sampler.logs.importing import Options, keep_rejected
from surrogym_sampler.logs.reading import format_of
from surrogym_shared.logs.columns import roles_by_name
from surrogym_shared.logs.table import stamps
from surrogym_shared.spec import BoxAction, DiscreteAction


def read(path: Path, **changes) -> ReadLog:
    return read_log(path, Options(mapping=reactor.MAPPING | changes))


def test_every_log_file_format_gives_the_same_steps(tmp_path: Path):
    pytest.importorskip("pyarrow")
    module = reactor.example()
    rows = list(module.operate(runs=3, length=20))
    found = {}
    for ending in ("csv", "npz", "parquet"):
        module.write(str(tmp_path / f"log.{ending}"), rows)
        found[ending] = read_log(tmp_path / f"log.{ending}")
    assert {ending: len(log.steps) for ending, log in found.items()} == dict.fromkeys(found, 60)
    assert len({log.steps.digest for log in found.values()}) == 1
    assert len({log.spec.model_dump_json() for log in found.values()}) == 1


def test_the_error_for_a_log_format_with_missing_package_tells_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    monkeypatch.setitem(sys.modules, "minari", None)
    (tmp_path / "log.parquet").write_bytes(b"PAR1 and so on")
    with pytest.raises(UnusableLog, match=r"needs the package pyarrow: pip install 'surrogym\[logs\]'"):
        read_log(tmp_path / "log.parquet")
    with pytest.raises(UnusableLog, match="needs the package minari"):
        read_log("pendulum/random-v0")


def test_the_steps_of_a_minari_data_set_are_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    minari = pytest.importorskip("minari")
    pytest.importorskip("h5py")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    rng = np.random.default_rng(0)
    episodes = [
        minari.data_collector.EpisodeBuffer(
            id=number,
            observations=rng.normal(size=(6, 2)),
            actions=rng.uniform(-1, 1, (5, 1)),
            rewards=rng.normal(size=5).tolist(),
            terminations=[False] * 4 + [number == 0],
            truncations=[False] * 4 + [number == 1],
        )
        for number in range(2)
    ]
    box = gymnasium.spaces.Box
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # what it would like to know beside the steps
        minari.create_dataset_from_buffers(
            "reactor/made-v0",
            episodes,
            action_space=box(-1, 1, (1,), dtype=np.float64),
            observation_space=box(-9, 9, (2,), dtype=np.float64),
        )
    log = read_log("reactor/made-v0")
    assert (len(log.steps), log.steps.terminated.sum(), log.steps.truncated.sum()) == (10, 1, 1)
    np.testing.assert_array_equal(log.steps.q_next[4], episodes[0].observations[5])
    assert log.spec.coordinate_names == ("s0", "s1")
    steps = [(episode, t) for episode in episodes for t in range(5)]
    np.savez(
        tmp_path / "same.npz",
        observations=np.stack([episode.observations[t] for episode, t in steps]),
        next_observations=np.stack([episode.observations[t + 1] for episode, t in steps]),
        actions=np.stack([episode.actions[t] for episode, t in steps]),
        rewards=[episode.rewards[t] for episode, t in steps],
        terminations=[episode.terminations[t] for episode, t in steps],
        truncations=[episode.truncations[t] for episode, t in steps],
        episode=np.repeat([0, 1], 5),
    )
    same = read_log(tmp_path / "same.npz")
    assert same.steps.digest == log.steps.digest, "so the model is the same"
    assert log.spec.action == BoxAction(low=(-1,), high=(1,)), "the declared space, and not the values in the log"
    assert same.spec.model_copy(update={"environment": log.spec.environment, "action": log.spec.action}) == log.spec


@pytest.mark.parametrize(
    ("spaces", "says"),
    [
        ({}, ""),
        ({"observation_space": gymnasium.spaces.Discrete(5)}, "expected observations that are vectors"),
        ({"action_space": gymnasium.spaces.Discrete(4, start=1)}, "expected actions of a Box"),
        ({"action_space": gymnasium.spaces.MultiDiscrete([2, 2])}, "expected actions of a Box"),
    ],
)
def test_the_declared_spaces_of_a_minari_data_set_determine_the_action_type(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, spaces: dict[str, gymnasium.Space], says: str
):
    """A discrete action whose values have a gap was continuous, and a label was a number."""
    minari = pytest.importorskip("minari")
    pytest.importorskip("h5py")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    declared = {
        "observation_space": gymnasium.spaces.Box(-9, 9, (2, 1), dtype=np.float64),
        "action_space": gymnasium.spaces.Discrete(4),
    } | spaces
    for space in declared.values():
        space.seed(0)
    episode = minari.data_collector.EpisodeBuffer(
        id=0,
        observations=np.array([declared["observation_space"].sample() for _ in range(7)]),
        actions=np.array([2, 0, 2, 0, 0, 2]) if not says else [declared["action_space"].sample() for _ in range(6)],
        rewards=[0.0, 1.0, 2.0, 3.0, 4.0, 5.0],
        terminations=[False] * 6,
        truncations=[False] * 5 + [True],
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        minari.create_dataset_from_buffers("reactor/declared-v0", [episode], **declared)
    if says:
        with pytest.raises(UnusableLog, match=says):
            read_log("reactor/declared-v0")
        return
    log = read_log("reactor/declared-v0")
    assert (log.spec.action, log.spec.coordinate_names) == (DiscreteAction(n=4), ("s0", "s1"))


def test_exactly_the_invalid_log_rows_are_set_aside(tmp_path: Path):
    whole = reactor.log(runs=50, length=100)
    damaged, ways = reactor.broken(whole, share=0.01)
    assert set(ways.values()) == set(reactor.WAYS), "every way is there"
    log = read(damaged.write(tmp_path / "log.csv"))
    assert [line for line, _ in log.rejected] == sorted(ways)
    for line, reason in log.rejected:
        assert reactor.WAYS[ways[line]] in reason
    assert len(log.steps) == len(whole.rows) - len(ways)


def test_rejected_log_rows_are_written_with_line_reason_and_cells(tmp_path: Path):
    damaged = reactor.log().at(3, "reward", "oops")
    path = damaged.write(tmp_path / "log.csv")
    file = keep_rejected(path, read(path))
    assert file == tmp_path / "log.rejected.csv"
    [heading, row] = list(csv.reader(file.read_text().splitlines()))
    assert heading == ["line", "reason", *damaged.heading]
    assert row[:2] == ["5", "reward: expected a number, got 'oops'"]
    assert tuple(row[2:]) == damaged.rows[3]


def test_a_valid_log_leaves_no_file_of_rejected_rows(tmp_path: Path):
    path = reactor.log().write(tmp_path / "log.csv")
    assert keep_rejected(path, read(path)) is None
    assert [file.name for file in tmp_path.iterdir()] == ["log.csv"]


def test_next_states_are_taken_from_the_following_row_of_the_episode(tmp_path: Path):
    whole = reactor.log(runs=3, length=10)
    with_next = read(whole.write(tmp_path / "a.csv"))
    by_order = read(whole.without("next_concentration", "next_temperature").write(tmp_path / "b.csv"), next={})
    inner = np.arange(30) % 10 < 9  # the last row of an episode has no next state
    assert (len(by_order.steps), by_order.steps.ends) == (27, 3)
    np.testing.assert_array_equal(by_order.steps.q_next, with_next.steps.q_next[inner])
    np.testing.assert_array_equal(by_order.steps.u, with_next.steps.u[inner])


def test_a_missing_log_row_leaves_no_step_across_the_gap(tmp_path: Path):
    whole = reactor.log(runs=1, length=10).without("next_concentration", "next_temperature")
    log = read(whole.at(5, "temperature", "nan").write(tmp_path / "log.csv"), next={})
    assert log.steps.row.tolist() == [0, 1, 2, 3, 6, 7, 8], "4 has no next state, 5 no state, 9 is the end"


def test_an_invalid_logged_action_loses_only_its_own_step(tmp_path: Path):
    whole = reactor.log(runs=1, length=10).without("next_concentration", "next_temperature")
    log = read(whole.at(5, "action_coolant", "nan").write(tmp_path / "log.csv"), next={})
    assert log.steps.row.tolist() == [0, 1, 2, 3, 4, 6, 7, 8]


def test_a_time_column_that_restarts_begins_a_new_episode(tmp_path: Path):
    whole = reactor.log(runs=2, length=10).without("run", "next_concentration", "next_temperature")
    log = read(whole.write(tmp_path / "log.csv"), next={}, episode=None)
    assert (log.steps.episodes, log.rejected) == ((10, 10), [])


def test_a_gap_in_the_time_column_gives_no_step(tmp_path: Path):
    whole = reactor.log(runs=1, length=10).without("next_concentration", "next_temperature")
    for row in range(6, 10):
        whole = whole.at(row, "time", repr(float(whole.rows[row][1]) + 30))
    assert read(whole.write(tmp_path / "log.csv"), next={}).steps.row.tolist() == [0, 1, 2, 3, 4, 6, 7, 8]


def test_the_time_column_of_a_log_may_contain_dates(tmp_path: Path):
    whole = reactor.log(runs=1, length=10)
    for row in range(10):
        whole = whole.at(row, "time", f"2026-03-01T12:{row:02d}:00Z")
    log = read(whole.write(tmp_path / "log.csv"))
    assert (log.steps.interval, log.rejected) == (60.0, [])


@pytest.mark.parametrize(
    ("form", "minutes"), [("2024033123{:02d}00", 1), ("2024033123{:02d}", 1), ("20240331T23{:02d}00", 1)]
)
def test_unix_time_stamps_in_a_log_are_read_as_times(tmp_path: Path, form: str, minutes: int):
    """Their numbers jumped by 7,640 at midnight, and by 40 at each full minute."""
    whole = reactor.log(runs=1, length=10)
    for row in range(10):
        stamp = form.format(53 + row) if row < 7 else form.replace("033123", "040100").replace("0331T23", "0401T00")
        whole = whole.at(row, "time", stamp if row < 7 else stamp.format(row - 7))
    log = read(whole.write(tmp_path / "log.csv"))
    assert (log.steps.interval, log.rejected, len(log.steps)) == (60.0 * minutes, [], 10)


@pytest.mark.parametrize("values", [[2.0, 3.0, 4.0, 5.0], [20240399.0, 20240400, 20240401, 20250000]])
def test_other_large_numbers_are_not_read_as_time_stamps(values: list[float]):
    assert stamps(np.array(values)) is None


def test_dates_written_as_digits_are_read_as_dates():
    found = stamps(np.array([20240228.0, 20240229, 20240301, 20240302, np.nan] + [20240303.0] * 9))
    assert found is not None
    assert np.diff(found[:4]).tolist() == [86_400.0] * 3
    assert np.isnan(found[4])


def test_a_file_of_rejected_rows_has_no_formulas_and_no_control_characters(tmp_path: Path):
    cells = ["=1+1", " @cmd", "+oops", "-1e3x", "\x1b[2Jred", "＝1", "-5.5"]
    whole = reactor.log()
    for row, cell in enumerate(cells, 3):
        whole = whole.at(row, "reward" if cell != "-5.5" else "temperature", cell)
    whole = reactor.Log(tuple("=cmd" if name == "time" else name for name in whole.heading), whole.rows)
    log = read(whole.write(tmp_path / "log.csv"), time=None)
    file = keep_rejected(tmp_path / "log.csv", log)
    assert file is not None
    [heading, *rows] = list(csv.reader(file.read_text(encoding="utf-8").splitlines()))
    assert "'=cmd" in heading
    found = [row[heading.index("reward")] for row in rows[:-1]]
    assert found == ["'=1+1", "' @cmd", "'+oops", "'-1e3x", "\\x1b[2Jred", "'＝1"]
    assert rows[-1][heading.index("temperature")] == "-5.5", "a number stays a number"


def test_the_roles_of_log_columns_are_recognised_by_their_names():
    roles = roles_by_name(["Run", "t", "T", "c", "action_valve", "T_next", "next_c", "done", "reward"])
    assert (roles.state, roles.action) == ({"T": "T", "c": "c"}, {"valve": "action_valve"})
    assert roles.following == {"T": "T_next", "c": "next_c"}
    assert (roles.time, roles.episode, roles.terminated, roles.reward) == ("t", "Run", "done", "reward")


def test_if_some_columns_are_marked_as_states_other_columns_are_ignored():
    roles = roles_by_name(["id", "q.theta", "q.speed", "u.0", "next.theta", "next.speed", "late", "reward"])
    assert (tuple(roles.state), tuple(roles.action), roles.ignored) == (("theta", "speed"), ("0",), ("id", "late"))


@pytest.mark.parametrize(
    ("heading", "says"),
    [
        (["a", "b"], "expected a column of the action, such as action_valve, got \\['a', 'b'\\]"),
        (["action"], "expected a column of the state"),
        (["a", "b", "action", "next_a"], "columns of the next state for all states"),
    ],
)
def test_a_log_whose_column_names_are_not_sufficient_is_refused(heading: list[str], says: str):
    with pytest.raises(UnusableLog, match=says):
        roles_by_name(heading)


def test_a_mapping_that_names_an_unknown_column_is_refused(tmp_path: Path):
    path = reactor.log().write(tmp_path / "log.csv")
    with pytest.raises(UnusableLog, match="names the column 'TT-101': expected one of"):
        read(path, state={"T": "TT-101"})


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("state = 3\naction = ['b']", "state: expected a list of columns, or a table of your names .*, got 3$"),
        (
            "state = ['a']\nakcja = ['b']",
            "expected the key action with a list of .*, got none; expected the keys state, action, .* got 'akcja'$",
        ),
        ("state = ['a']\naction = ['b']\nreward = 1", "reward: expected the name of a column, got 1$"),
        ("state = ['a']\naction = ['b']\n[limits]\na = [1]", r"limits: expected a table of .*, got {'a': \[1\]}$"),
        ("state = ['a']\naction = ['b']\nangles = 'a'", "angles: expected a list of names of states, got 'a'$"),
    ],
)
def test_a_column_mapping_of_wrong_structure_is_refused_with_an_explanation(tmp_path: Path, text: str, says: str):
    (tmp_path / "log.csv").write_text("a,b\n1,1\n2,0\n3,1\n")
    (tmp_path / "map.toml").write_text(text)
    with pytest.raises(UnusableLog, match="map.toml is not a mapping of columns: .*" + says):
        read_log(tmp_path / "log.csv", Options(mapping=tmp_path / "map.toml"))


def test_a_log_with_too_many_states_is_refused():
    with pytest.raises(UnusableLog, match="expected at most 64 states, got 65"):
        roles_by_name(["action", *(f"x{i}" for i in range(65))])


def test_a_column_mapping_can_be_toml_or_json(tmp_path: Path):
    path = reactor.log().without("next_concentration", "next_temperature").write(tmp_path / "log.csv")
    plain = {"state": ["temperature"], "action": ["action_coolant"], "time": "time"}
    (tmp_path / "map.json").write_text(json.dumps(plain))
    (tmp_path / "map.toml").write_text('state = ["temperature"]\naction = ["action_coolant"]\ntime = "time"\n')
    specs = [read_log(path, Options(mapping=tmp_path / f"map.{kind}")).spec for kind in ("json", "toml")]
    assert specs[0] == specs[1]


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"", "expected a log with a heading"),
        (b"a,action\n", "or a log with a heading and rows, got neither"),
        (b"a,a,action\n1,1,1\n", "got 'a' 2 times"),
        (b"\xff\xfe\x00", "expected text in UTF-16 in .*: the file may be cut off"),
        (b"PK\x03\x04 no zip", "expected an NPZ file in .*, got a damaged or incomplete zip"),
        (b"a,action\nx,y\n", "expected two usable steps at least, got 0"),
    ],
)
def test_an_invalid_log_is_refused_in_a_sentence(tmp_path: Path, content: bytes, says: str):
    path = tmp_path / "log"
    path.write_bytes(content)
    with pytest.raises(UnusableLog, match=says):
        read_log(path)


def test_the_error_for_a_missing_log_file_names_it(tmp_path: Path):
    with pytest.raises(FileNotFoundError, match=r"nothing\.csv"):
        format_of(tmp_path / "nothing.csv")


def test_a_folder_without_a_data_set_is_refused_in_a_sentence(tmp_path: Path):
    (tmp_path / "data").mkdir()
    says = r"expected a CSV, Parquet or NPZ file, or a Minari data set, got the folder .* which has no data/main_data"
    with pytest.raises(UnusableLog, match=says):
        read_log(tmp_path, Options(mapping={"state": ["a"], "action": ["b"]}))


def test_a_folder_with_a_broken_data_set_is_refused(tmp_path: Path):
    pytest.importorskip("minari")
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "metadata.json").write_text("{}")
    with pytest.raises(UnusableLog, match=r"expected the metadata of a Minari data set in .* got others"):
        read_log(tmp_path)
