"""A column in another unit, or outside its range, is named with the way out; wide logs and a few wild rows are not."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from support import reactor
from support.server import ServerProcess
from surrogym_client.transport import Api
from surrogym_sampler.logs import importing
from surrogym_sampler.original.classic import pendulum
from surrogym_shared.logs.checking import ReadLog, check_log, draft_log
from surrogym_shared.logs.columns import roles_by_name
from surrogym_shared.logs.rows import require_reward_unit, require_units
from surrogym_shared.logs.table import Table, UnusableLog
from surrogym_shared.spec import BoxAction, Coordinate, EnvironmentSpec, ObservationEntry, Term, Uniform


def states(speed: np.ndarray) -> np.ndarray:
    return np.stack([np.zeros_like(speed), speed], axis=1)


@pytest.mark.parametrize("factor", [1_000.0, 1e5])
def test_a_log_column_a_thousand_times_its_sampling_range_is_refused(factor: float) -> None:
    speeds = states(factor * np.linspace(-8, 8, 50))
    with pytest.raises(UnusableLog, match=r"speed: half of the log lies between .* is the column in another unit\?"):
        require_units(speeds, pendulum())


def test_a_log_column_shifted_out_of_its_sampling_range_is_refused() -> None:
    with pytest.raises(UnusableLog, match="speed"):
        require_units(states(np.linspace(-8, 8, 50) + 1_000), pendulum())


def test_a_few_outliers_and_missing_values_do_not_suggest_another_unit() -> None:
    speeds = np.linspace(-12, 12, 50)
    speeds[:5], speeds[5:8] = 1e6, np.nan
    require_units(states(speeds), pendulum())


CONVERSIONS = {
    "degrees Celsius to kelvin": (1.0, 273.15),
    "degrees Celsius to Fahrenheit": (1.8, 32.0),
    "metres to millimetres": (1e3, 0.0),
    "millimetres to metres": (1e-3, 0.0),
    "bar to pascal": (1e5, 0.0),
    "pascal to bar": (1e-5, 0.0),
    "radians to degrees": (57.2958, 0.0),
    "degrees to radians": (1 / 57.2958, 0.0),
    "shares to percent": (100.0, 0.0),
    "percent to shares": (0.01, 0.0),
    "metres a second to kilometres an hour": (3.6, 0.0),
    "revolutions a minute to radians a second": (0.10472, 0.0),
}


@pytest.mark.parametrize("conversion", CONVERSIONS)
def test_a_log_column_in_another_unit_is_refused_or_reported(conversion: str) -> None:
    """Those that shrink a column were taken without a word, and so was a factor of 3.6."""
    factor, zero = CONVERSIONS[conversion]
    for seed in range(20):
        rng = np.random.default_rng(seed)
        spec, x = drawn(rng)
        assert checked(spec, x).notes == ()
        try:
            notes = checked(spec, factor * x + zero).notes
        except UnusableLog as refused:
            notes = (str(refused),)
        assert any(note.startswith("x:") and "in another unit" in note for note in notes), seed


def drawn(rng: np.random.Generator) -> tuple[EnvironmentSpec, np.ndarray]:
    """A specification of one state, and states of a log that covers most of its range."""
    half = float(rng.uniform(0.5, 5))
    middle = float(rng.uniform(-half, half))
    low, high = middle - half, middle + half
    sampling = Uniform(low=low, high=high)
    spec = EnvironmentSpec(
        environment="drawn",
        coordinates=(Coordinate(name="x", sampling=sampling),),
        observation=(ObservationEntry(name="x", term=Term.linear(x=1)),),
        action=BoxAction(low=(-1.0,), high=(1.0,)),
        start={"x": sampling},
        time_limit=20,
    )
    return spec, middle + half * rng.uniform(-0.9, 0.9, 80)


def checked(spec: EnvironmentSpec, x: np.ndarray) -> ReadLog:
    columns = {"x": x, "action_u": np.linspace(-1, 1, len(x)), "reward": -x}
    table = Table(columns, np.arange(2, 2 + len(x)))
    return check_log(table, roles_by_name(table.names), spec)


CELSIUS = -273.15


def celsius(tmp_path: Path) -> tuple[Path, Path]:
    """A log of the reactor, and the same log with temperatures in degrees Celsius."""
    log = reactor.log(runs=3, length=20)
    other = log
    for column in ("temperature", "next_temperature"):
        place = log.heading.index(column)
        for row, cells in enumerate(log.rows):
            other = other.at(row, column, repr(float(cells[place]) + CELSIUS))
    return log.write(tmp_path / "kelvin.csv"), other.write(tmp_path / "celsius.csv")


def test_a_log_in_celsius_is_refused_for_a_range_in_kelvin(tmp_path: Path) -> None:
    """It lies only three widths of the range away: 60 steps went into the model of a surrogate in kelvin."""
    log, other = celsius(tmp_path)
    spec = importing.read_log(log).spec
    assert len(importing.read_log(log, importing.Options(spec=spec)).steps)
    with pytest.raises(UnusableLog) as refused:
        importing.read_log(other, importing.Options(spec=spec))
    said = str(refused.value)
    assert said.startswith("temperature: half of the log lies between ")
    assert "outside its sampling range of " in said
    assert "is the column in another unit? Convert it, or name another column (--map)" in said
    assert said.endswith("If the values are right, widen the sampling range in a new specification (--spec)")


def test_a_log_in_the_wrong_unit_is_refused_before_any_step_is_sent(
    server_process: ServerProcess, tmp_path: Path
) -> None:
    log, other = celsius(tmp_path)
    importing.import_log(log, register="in-kelvin", url=server_process.url)
    with pytest.raises(UnusableLog, match="outside its sampling range"):
        importing.import_log(other, to="in-kelvin", url=server_process.url)
    spec = importing.read_log(log).spec
    with pytest.raises(UnusableLog, match="outside its sampling range"):
        importing.import_log(other, register="no-celsius", spec=spec, url=server_process.url)
    with Api(server_process.url) as api:
        assert api.surrogate("in-kelvin").samples == 60
        assert "no-celsius" not in [one.name for one in api.surrogates()]


@pytest.mark.parametrize(("low", "high"), [(8.1, 12.0), (-12.0, -8.1)])
def test_a_log_column_just_outside_its_sampling_range_is_refused(low: float, high: float) -> None:
    with pytest.raises(UnusableLog, match=r"speed: half of the log lies between .*, outside its sampling range of -8"):
        require_units(states(np.linspace(low, high, 50)), pendulum())


@pytest.mark.parametrize(
    ("low", "high"),
    [
        (7.0, 7.5),  # one operating region
        (4.0, 18.0),  # less than a third of it within the range
        (8.0 + 1e-6, 8.0 + 1e-6),  # a constant at an end, in single precision
        (-30.0, 30.0),
    ],
)
def test_a_log_that_partly_lies_in_the_sampling_range_is_accepted(low: float, high: float) -> None:
    require_units(states(np.linspace(low, high, 50)), pendulum())


def test_logged_angles_of_any_turn_are_accepted() -> None:
    turns = np.stack([np.linspace(30.0, 40.0, 50), np.zeros(50)], axis=1)
    require_units(turns, pendulum())


def test_reading_a_log_in_another_unit_than_the_specification_is_refused(tmp_path) -> None:
    log = reactor.log(runs=3, length=20).write(tmp_path / "log.csv")
    spec = importing.read_log(log).spec
    small = spec.model_dump()
    small["coordinates"][1]["sampling"] = {"kind": "uniform", "low": 0.30, "high": 0.34}  # kilokelvin
    small["start"][small["coordinates"][1]["name"]] = {"kind": "fixed", "value": 0.3}
    small["starts"] = []
    options = importing.Options(spec=type(spec).model_validate(small))
    with pytest.raises(UnusableLog, match="is the column in another unit"):
        importing.read_log(log, options)


def test_next_states_in_another_unit_than_the_sampling_range_are_refused(tmp_path) -> None:
    """Only current states were checked: next states of a thousand times their size reached the model."""
    log = reactor.log(runs=3, length=20).write(tmp_path / "log.csv")
    read = importing.read_log(log)
    q, u, q_next = read.steps.q, read.steps.u, read.steps.q_next
    names = read.spec.coordinate_names
    columns = {name: q[:, i] for i, name in enumerate(names)} | {f"next_{n}": q_next[:, i] for i, n in enumerate(names)}
    columns |= {f"action_{i}": u[:, i] for i in range(u.shape[1])} | {"reward": read.reward}
    np.savez(tmp_path / "same.npz", **columns)
    options = importing.Options(spec=read.spec)
    assert len(importing.read_log(tmp_path / "same.npz", options).steps) == len(q)
    free = read.spec.model_dump()
    for coordinate in free["coordinates"]:
        coordinate["bounds"] = None  # a bound would set each row aside
    options = importing.Options(spec=type(read.spec).model_validate(free))
    np.savez(tmp_path / "other.npz", **columns | {f"next_{names[0]}": 1_000 * q_next[:, 0]})
    with pytest.raises(UnusableLog, match=f"next {names[0]}: half of the log lies between"):
        importing.read_log(tmp_path / "other.npz", options)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_logged_rewards_a_thousand_times_those_of_the_samples_are_refused(sign: float) -> None:
    """Dollars instead of thousands of dollars: the model of both would predict neither."""
    known = sign * np.linspace(0.5, 2, 50)
    with pytest.raises(
        UnusableLog, match=r"reward: half of the log lies between .* the samples of 'tank' have rewards"
    ):
        require_reward_unit(1_000 * known, known, "tank")
    with pytest.raises(UnusableLog, match="reward"):
        require_reward_unit(1_000 * np.linspace(-1, 1, 50), known, "tank")


@pytest.mark.parametrize(
    "known",
    [
        np.linspace(-3.0, 0.0, 50),  # the same unit, and other regions
        np.zeros(50),  # a sparse reward, which no sample has met
        np.full(3, 0.001),  # too few samples
        np.zeros(0),
    ],
)
def test_logged_rewards_that_merely_differ_from_the_samples_are_accepted(known: np.ndarray) -> None:
    paid = np.linspace(-40, 5, 50)
    paid[:5] = -1e6  # a few crashes
    require_reward_unit(paid, known, "tank")


def clocked(heading: str, interval: float) -> Table:
    times = interval * np.arange(40)
    cells = {heading: times, "T": np.sin(np.arange(40.0)), "action_u": np.cos(np.arange(40.0)), "reward": np.zeros(40)}
    return Table(cells, np.arange(2, 42))


CLOCKS = {"time_s": 1.0, "time [ms]": 1e-3, "time (us)": 1e-6, "time [min]": 60.0, "time": 1.0}  # seconds of a unit


@pytest.mark.parametrize("heading", CLOCKS)
@pytest.mark.parametrize("factor", [0.5, 2.0, 1.0, 1.05])
def test_a_log_of_another_sampling_period_than_the_specification_is_refused(heading: str, factor: float) -> None:
    table = clocked(heading, 0.5 / CLOCKS[heading])
    own = draft_log(table, roles_by_name(list(table.columns)), "tank").spec.model_copy(update={"sampling_period": 0.5})
    other = clocked(heading, factor * 0.5 / CLOCKS[heading])
    if abs(factor - 1) <= 0.1:
        check_log(other, roles_by_name(list(other.columns)), own)
        return
    with pytest.raises(UnusableLog, match=r"expected a step every 0\.5 s, the sampling_period .* got one every"):
        check_log(other, roles_by_name(list(other.columns)), own)


def test_a_draft_declares_the_sampling_period_of_a_clock_with_a_unit() -> None:
    for heading, unit in CLOCKS.items():
        table = clocked(heading, 0.5 / unit)
        period = draft_log(table, roles_by_name(list(table.columns)), "tank").spec.sampling_period
        assert period == (None if heading == "time" else 0.5)
