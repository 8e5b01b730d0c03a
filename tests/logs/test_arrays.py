"""Arrays of a file: which are columns, which are ignored, and which shapes are refused."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from surrogym_sampler.logs import ReadLog, UnusableLog, read_log

RNG = np.random.default_rng(0)
STATES = RNG.normal(size=(21, 2))
VECTORS = {"states": STATES[:-1], "next_states": STATES[1:], "u": RNG.uniform(-1, 1, 20), "r": np.arange(20.0)}


def read(folder: Path, **arrays) -> ReadLog:
    np.savez(folder / "log.npz", **arrays)
    return read_log(folder / "log.npz")


@pytest.mark.parametrize("name", ["states", "actions", "next_states"])
def test_log_arrays_shaped_by_episode_are_refused_with_their_shape(tmp_path: Path, name: str):
    arrays = {"states": STATES, "actions": STATES, "rewards": np.zeros((6, 100))} | {name: np.zeros((6, 100, 2))}
    with pytest.raises(UnusableLog, match=rf"for the array {name} in .*, got \(6, 100, 2\)"):
        read(tmp_path, **arrays)


@pytest.mark.parametrize("spare", [np.float64(0.05), np.array([0.05]), np.zeros((2, 3, 4)), np.array(["a", "b"])])
def test_a_log_array_without_one_value_per_step_is_ignored(tmp_path: Path, spare: np.ndarray):
    log = read(tmp_path, **VECTORS, dt=spare)
    assert len(log.steps) == 20
    assert log.ignored == {"dt": f"its shape {spare.shape} is not one value a step"}


def test_log_arrays_of_different_length_are_refused(tmp_path: Path):
    with pytest.raises(UnusableLog, match="expected arrays with the same number of rows in"):
        read(tmp_path, x=np.zeros(20), speed=np.zeros(21), action=np.zeros(20))
    with pytest.raises(UnusableLog, match="expected arrays with the same number of rows in"):
        read(tmp_path, **VECTORS | {"r": np.zeros(21)})


def test_a_reward_array_with_one_column_is_read_as_the_reward(tmp_path: Path):
    log = read(tmp_path, **VECTORS | {"r": np.arange(20.0)[:, None]})
    assert log.steps.reward is not None
    assert log.steps.reward.tolist() == list(range(20))


def test_the_import_command_prints_the_role_of_each_column(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    from surrogym.cli import main

    path = tmp_path / "log.npz"
    np.savez(path, **VECTORS, late=np.zeros(20), dt=0.05)
    for options in ([], ["--json"]):
        with pytest.raises(SystemExit) as ended:
            main(["import", str(path), *options])
        assert not ended.value.code
        told = capsys.readouterr().out
        if not options:
            assert "  u: action 0\n  next.s0: next state s0\n" in told
            assert "  dt: ignored, as its shape () is not one value a step\n" in told
            assert "  late: ignored, as it has no role\n" in told
            continue
        read_back = json.loads(told)
        assert read_back["columns"]["r"] == "reward"
        assert set(read_back["ignored"]) == {"dt", "late"}


MOMENTS = np.arange(20).astype("M8[s]")


@pytest.mark.parametrize(
    ("cells", "kind"),
    [
        (np.where(np.arange(20) == 5, np.datetime64("NaT"), MOMENTS), "dates"),
        (np.arange(20).astype("m8[s]"), "durations"),
        (np.arange(20) + 1j, "complex numbers"),
        (np.zeros(20, dtype=[("a", "f8"), ("b", "f8")]), "records"),
    ],
)
@pytest.mark.parametrize("column", ["x", "next_x", "action", "reward"])
def test_dates_durations_and_complex_numbers_in_number_columns_are_refused(
    tmp_path: Path, cells: np.ndarray, kind: str, column: str
):
    """They were cast: a missing date was a state of -9.2e18, and an imaginary part was lost."""
    arrays = {"x": STATES[:-1, 0], "next_x": STATES[1:, 0], "action": VECTORS["u"], "reward": VECTORS["r"]}
    with pytest.raises(UnusableLog, match=f"{column}: expected a column of numbers, got {kind}"):
        read(tmp_path, **arrays | {column: cells})


@pytest.mark.parametrize("unit", ["M8[ms]", "m8[ms]"])
def test_time_columns_of_a_log_may_contain_dates_or_durations(tmp_path: Path, unit: str):
    log = read(tmp_path, x=STATES[:-1, 0], action=VECTORS["u"], time=(500 * np.arange(20)).astype(unit))
    assert log.steps.interval == pytest.approx(0.5)


@pytest.mark.parametrize(
    ("more", "says"),
    [
        ({"obs": STATES[:-1]}, r"one array for the column 'q.s0' in .*, got two, states and obs"),
        ({"next_obs": STATES[:-1]}, r"one array for the column 'next.s0' in .*, got two, next_states and next_obs"),
        ({"action": np.zeros(20)}, r"one column for the action '0', got two: u and action"),
        ({"coordinate_names": np.array(["a", "a"])}, r"different names in coordinate_names of .*, got \['a', 'a'\]"),
        ({"coordinate_names": np.array(["a"])}, r"2 names in coordinate_names of .*, one for each column of states"),
        ({"r": np.zeros((20, 2))}, r"one value for each step in r, got an array of shape \(20, 2\)"),
    ],
)
def test_log_arrays_with_conflicting_names_are_refused(tmp_path: Path, more: dict[str, np.ndarray], says: str):
    """One of them won silently, or became columns of states."""
    with pytest.raises(UnusableLog, match=says):
        read(tmp_path, **VECTORS | more)
