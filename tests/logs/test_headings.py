"""Headings with units, and columns that number rows: read right, or asked for, and no states in silence."""

from __future__ import annotations

import itertools
import random
from pathlib import Path

import numpy as np
import pytest

from surrogym_sampler.logs import ReadLog, UnusableLog, read_log
from surrogym_sampler.logs.importing import Options
from surrogym_shared.logs.columns import heading, roles_by_name

ROWS = 24
UNITS = {
    "time": ("s", "ms", "min", "h"),
    "T": ("K", "°C", "degF"),
    "heat": ("W", "kW", "%"),
    "reward": ("-", "EUR", ""),
}
KNOWN = {
    "time": ["time", "Time", "t", "timestamp", "Time Stamp", "timeStamp"],
    "T": ["T"],
    "heat": ["action_heat", "u.heat", "Action heat"],
    "reward": ["reward", "Reward", "rewards"],
}
ASKED = {
    "time": ["elapsed", "sim_time", "clock", "elapsedTime", "Datetime", "ms", "Zeit"],
    "reward": ["step_reward", "cost", "stepReward", "total reward", "Score"],
    "terminated": ["is_done", "failed", "episode_end", "isTerminal done"],
    "episode": ["episode number", "traj", "rollout_no", "batch"],
}


def plant(seed: int) -> dict[str, list[float]]:
    rng = random.Random(seed)
    warm, found = 20.0, {"time": [], "T": [], "heat": [], "reward": []}
    for k in range(ROWS):
        heat = round(rng.uniform(0, 1), 3)
        for name, value in zip(found, (k * 0.5, round(warm, 3), heat, round(-abs(warm - 21), 3)), strict=True):
            found[name].append(value)
        warm += heat - 0.1 * (warm - 18)
    return found


def write(path: Path, columns: dict[str, list[float]]) -> Path:
    lines = [list(columns), *zip(*columns.values(), strict=True)]
    path.write_text("".join(";".join(map(str, line)) + "\n" for line in lines), encoding="utf-8")
    return path


def assert_tank(log: ReadLog, columns: dict[str, list[float]], *, time: bool = True) -> None:
    assert list(log.roles.state.values()) == [next(iter(log.roles.state.values()))]
    np.testing.assert_array_equal(log.steps.q[:, 0], columns["T"][:-1])
    np.testing.assert_array_equal(log.steps.u[:, 0], columns["heat"][:-1])
    np.testing.assert_array_equal(log.reward, columns["reward"][:-1])
    assert log.steps.interval == (0.5 if time else None)


@pytest.mark.parametrize("seed", range(40))
def test_log_headings_with_units_are_recognised_with_their_role(tmp_path: Path, seed: int):
    rng = random.Random(seed)
    forms = ["{} [{}]", "{}[{}]", "{} ({})", "{}({})", "{} / {}", "{} in {}"]
    columns = plant(seed)
    named = {}
    for role, cells in columns.items():
        unit, name = rng.choice(UNITS[role]), rng.choice(KNOWN[role])
        form = rng.choice(forms[:4] if unit in ("-", "") else forms)
        named[form.format(name, unit) if rng.random() < 0.8 else name] = cells
    if rng.random() < 0.3:
        named[rng.choice(["time_s", "t_ms", "timestampMs", "time_sec"])] = named.pop(next(iter(named)))
    order = list(named)
    rng.shuffle(order)
    log = read_log(write(tmp_path / "log.csv", {name: named[name] for name in order}))
    assert log.spec.coordinate_names == ("T",)
    assert_tank(log, columns)


@pytest.mark.parametrize("role", list(ASKED))
def test_a_log_column_whose_name_only_suggests_a_role_is_refused_with_a_question(tmp_path: Path, role: str):
    """The column became a state, and the reward was declared as 0."""
    shown = {"terminated": [0] * (ROWS - 1) + [1], "episode": [k // 8 for k in range(ROWS)]}
    for name, unit in itertools.product(ASKED[role], ["", " [x]", " (-)"]):
        columns = plant(0)
        cells = columns.pop(role) if role in columns else shown[role]
        named = {"action": columns.pop("heat"), **columns, name + unit: cells}
        with pytest.raises(UnusableLog, match=rf"is likely the {role}.*--map"):
            read_log(write(tmp_path / "log.csv", named))


def test_the_column_mapping_proposed_by_an_error_message_works(tmp_path: Path):
    import json

    columns = plant(0)
    named = {"elapsed": columns["time"], "T": columns["T"], "u": columns["heat"], "step_reward": columns["reward"]}
    path = write(tmp_path / "log.csv", named)
    with pytest.raises(UnusableLog) as refused:
        read_log(path)
    proposed = str(refused.value)
    mapping, _ = json.JSONDecoder().raw_decode(proposed[proposed.index("{") :])
    assert_tank(read_log(path, Options(mapping=mapping)), columns)


@pytest.mark.parametrize(
    "name", ["terminal_voltage", "time_to_go", "end_effector", "return_flow_is_reward_free", "dead"]
)
def test_a_state_column_whose_name_suggests_another_role_stays_a_state_by_its_values(tmp_path: Path, name: str):
    columns = plant(0)
    named = {"action": columns["heat"], name: columns["T"], "reward": columns["reward"]}
    if "reward" in name:
        with pytest.raises(UnusableLog, match="likely the reward"):
            read_log(write(tmp_path / "log.csv", named))
        return
    assert read_log(write(tmp_path / "log.csv", named)).spec.coordinate_names == (name,)


def test_single_letter_columns_with_a_physical_unit_are_read_as_states():
    roles = roles_by_name(["t [°C]", "r [m]", "T [K]", "t_d", "u [V]"])
    assert (roles.time, roles.reward, list(roles.state)) == (None, None, ["t", "r", "T", "t_d"])
    assert roles.units["t [°C]"] == "°C"


def test_next_states_in_another_unit_than_the_states_are_refused():
    assert roles_by_name(["T [K]", "T_next [K]", "u"]).following == {"T": "T_next [K]"}
    with pytest.raises(UnusableLog, match="expected the next state 'T' in K"):
        roles_by_name(["T [K]", "next_T [degC]", "u"])


def test_an_index_in_brackets_is_not_read_as_a_unit():
    assert [heading(name).unit for name in ("action[0]", "u(1)", "km/h", "x")] == [""] * 4


@pytest.mark.parametrize("seed", range(24))
def test_a_row_number_column_is_reported_and_ignored(tmp_path: Path, seed: int):
    rng = random.Random(seed)
    columns = plant(seed)
    first = rng.choice([0, 1, 7, -3, 10_000])
    cells = [first + k for k in range(ROWS)]
    if rng.random() < 0.3:
        cells = [float(cell) for cell in cells]
    name = rng.choice(["", "Unnamed: 0", "index", "step", "Zeile", "x9", "id"])
    named = {name: cells, "T": columns["T"], "action": columns["heat"], "reward": columns["reward"]}
    if with_time := rng.random() < 0.5:
        named["time [s]"] = columns["time"]
    log = read_log(write(tmp_path / "log.csv", named))
    assert_tank(log, columns, time=with_time)
    assert log.ignored == {name or "unnamed column 1": "it grows by one in each row, as the number of a row does"}


@pytest.mark.parametrize("seed", range(12))
def test_a_step_counter_that_restarts_separates_episodes(tmp_path: Path, seed: int):
    """The last row of an episode was joined with the first one of the next."""
    rng = random.Random(seed)
    lengths = [rng.randint(3, 8) for _ in range(3)]
    lengths.append(ROWS - sum(lengths))
    columns = plant(seed)
    first = rng.choice([0, 1])
    named = {
        rng.choice(["", "step", "index", "episode_step", "Unnamed: 0", "time step"]): [
            first + k for n in lengths for k in range(n)
        ]
    }
    named |= {"T": columns["T"], "u": columns["heat"], "reward": columns["reward"]}
    log = read_log(write(tmp_path / "log.csv", named))
    assert (log.steps.episodes, log.spec.coordinate_names) == (tuple(lengths), ("T",))
    ends = {sum(lengths[: k + 1]) - 1 for k in range(4)}
    assert ends.isdisjoint(
        row for row in log.steps.row.tolist() if not (log.steps.terminated | log.steps.truncated).any()
    )
    again = Options(mapping=log.roles.mapping.model_dump())
    assert read_log(tmp_path / "log.csv", again).steps.digest == log.steps.digest


def test_rows_missing_from_a_row_number_column_give_no_step_across_the_gap(tmp_path: Path):
    columns = plant(0)
    kept = [k for k in range(ROWS) if k not in (5, 6, 15)]
    named = {"": kept} | {
        name: [columns[key][k] for k in kept] for name, key in (("T", "T"), ("u", "heat"), ("reward", "reward"))
    }
    log = read_log(write(tmp_path / "log.csv", named))
    assert not {4, 12} & set(log.steps.row.tolist()), "the rows before the gaps"
    assert (len(log.steps), log.rejected) == (len(kept) - 3, [])


@pytest.mark.parametrize("name", ["", "index", "Unnamed: 0", "step"])
@pytest.mark.parametrize("order", [range(ROWS)[::-1], random.Random(0).sample(range(ROWS), ROWS)])
def test_rows_not_in_the_order_of_their_row_numbers_are_refused(tmp_path: Path, name: str, order: list[int]):
    columns = plant(0)
    named = {name: list(order), "T": columns["T"], "u": columns["heat"], "reward": columns["reward"]}
    with pytest.raises(UnusableLog, match=r"expected rows in the order of .*, got another order"):
        read_log(write(tmp_path / "log.csv", named))


def test_a_state_that_grows_in_every_row_is_reported(tmp_path: Path):
    columns = plant(0)
    named = {"tijd": [k + 0.1 * (k % 3) for k in range(ROWS)], "T": columns["T"], "u": columns["heat"]}
    log = read_log(write(tmp_path / "log.csv", {**named, "reward": columns["reward"]}))
    assert any(note.startswith("tijd: grows in each row") for note in log.notes)


@pytest.mark.parametrize("form", ["2024-03-31T00:00:{:02d}", "202403310000{:02d}"])
def test_a_column_of_dates_is_recognised_as_time_and_not_as_row_numbers(tmp_path: Path, form: str):
    columns = plant(0)
    named = {"stamp": [form.format(k) for k in range(ROWS)], "T": columns["T"], "u": columns["heat"]}
    with pytest.raises(UnusableLog, match="'stamp' is likely the time"):
        read_log(write(tmp_path / "log.csv", {**named, "reward": columns["reward"]}))


def test_a_restarting_step_counter_may_have_gaps(tmp_path: Path):
    columns = plant(0)
    steps = [0, 1, 3, 4, 5, 6, 7, 8, 0, 1, 2, 4, 5, 6, 7, 8, 0, 1, 2, 3, 4, 5, 6, 7]
    named = {"step": steps, "T": columns["T"], "u": columns["heat"], "reward": columns["reward"]}
    log = read_log(write(tmp_path / "log.csv", named))
    assert (log.spec.coordinate_names, log.steps.episodes) == (("T",), (8, 8, 8))
    assert not {1, 7, 10, 15} & set(log.steps.row.tolist()), "rows before a gap or a new start"


def test_a_counter_that_an_action_resets_is_read_as_a_state(tmp_path: Path):
    age, cells, actions = 0, [], []
    for k in range(ROWS):
        cells.append(age)
        actions.append(int(k % 5 == 4))
        age = 0 if actions[-1] else age + 1
    named = {"age": cells, "wear": plant(0)["T"], "action": actions, "reward": [-float(one) for one in cells]}
    assert read_log(write(tmp_path / "log.csv", named)).spec.coordinate_names == ("age", "wear")
