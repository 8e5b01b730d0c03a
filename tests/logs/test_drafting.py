"""What a drafted specification concludes from the data, and what it leaves to a person."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from support import reactor
from surrogym_sampler.logs import ReadLog, UnusableLog, read_log
from surrogym_sampler.logs.importing import Options
from surrogym_sampler.original import make
from surrogym_shared.spec import Bounds, BoxAction, DeclaredReward, DiscreteAction, Fixed, Uniform

RNG = np.random.default_rng(0)


def drafted(folder: Path, **columns) -> ReadLog:
    np.savez(folder / "log.npz", **columns)
    return read_log(folder / "log.npz")


def rows(count: int = 50, **changes) -> dict[str, np.ndarray]:
    """A walk x under an action that varies."""
    u = RNG.uniform(-1, 1, count)
    x = 1 + np.cumsum(0.1 * u)
    return {"x": x, "next_x": x + 0.1 * u, "action": u, "reward": -(x**2)} | changes


def test_the_specification_of_the_reactor_is_drafted_from_its_log(tmp_path: Path):
    module = reactor.example()
    module.write(str(tmp_path / "log.csv"), list(module.operate()))
    spec = read_log(tmp_path / "log.csv").spec
    concentration, temperature = spec.coordinates
    assert (concentration.kind, concentration.bounds) == ("linear", None)
    assert temperature.bounds == Bounds(high=400), "the relief valve shows in the data"
    assert spec.action == BoxAction(low=(280,), high=(320,))
    assert (spec.time_limit, spec.termination, spec.design.budget) == (100, (), 0)


def test_drafting_from_a_pendulum_log_finds_the_angle_and_the_speed_limit(tmp_path: Path):
    machine = make("Pendulum-v1")
    steps = []
    for _ in range(60):
        q = RNG.uniform([-math.pi, -8], [math.pi, 8])
        for _ in range(40):
            action = RNG.uniform(-2, 2, 1)
            step = machine.step_from(q, action)
            after = np.array(step.next_coordinates)
            after[0] = math.remainder(after[0], 2 * math.pi)
            steps.append((*q, *action, step.reward, *after))
            q = after
    theta, speed, action, reward, next_theta, next_speed = np.array(steps).T
    log = drafted(
        tmp_path, theta=theta, speed=speed, action=action, reward=reward, next_theta=next_theta, next_speed=next_speed
    )
    assert [c.kind for c in log.spec.coordinates] == ["angle", "linear"]
    assert log.spec.coordinates[1].bounds == Bounds(low=-8, high=8)
    assert log.spec.observation_names == ("cos(theta)", "sin(theta)", "speed")


def test_a_logged_angle_between_0_and_2_pi_is_drafted_as_angle(tmp_path: Path):
    turned = np.arange(200) * 0.3
    u = RNG.uniform(-1, 1, 200)
    two_pi = 2 * math.pi
    log = drafted(tmp_path, a=turned % two_pi, next_a=(turned + 0.3) % two_pi, action=u, reward=u)
    assert log.spec.coordinates[0].kind == "angle"
    assert log.steps.q.min() < -3
    assert log.steps.q.max() < math.pi


def test_constant_log_columns_are_left_out_of_the_draft_and_reported(tmp_path: Path):
    log = drafted(tmp_path, **rows(p=np.full(50, 3.0), next_p=np.full(50, 3.0)))
    assert log.spec.coordinate_names == ("x",)
    assert "p: always 3, left out" in log.notes


def test_a_state_that_is_fixed_within_episodes_is_drafted_as_constant(tmp_path: Path):
    goal = np.repeat(RNG.uniform(-1, 1, 5), 10)
    log = drafted(tmp_path, **rows(goal=goal, next_goal=goal))
    assert {c.name: c.kind for c in log.spec.coordinates} == {"x": "linear", "goal": "constant"}


@pytest.mark.parametrize("name", ["setpoint", "x_SP", "SetPoint", "set_point", "LIC-101.SP", "x target", "reference"])
def test_the_draft_asks_about_a_set_point_that_moves_within_an_episode(tmp_path: Path, name: str):
    stepped = np.repeat(RNG.uniform(-1, 1, 5), 10)
    log = drafted(tmp_path, **rows(**{name: stepped, f"next_{name}": np.append(stepped[1:], stepped[-1])}))
    assert {c.name: c.kind for c in log.spec.coordinates} == {"x": "linear", name: "linear"}
    assert [note for note in log.notes if f'declare constants = ["{name}"]' in note]


@pytest.mark.parametrize("name", ["spin", "speed", "point"])
def test_the_draft_does_not_ask_about_states_without_a_word_for_set_points(tmp_path: Path, name: str):
    walk = np.cumsum(RNG.uniform(-1, 1, 51))
    log = drafted(tmp_path, **rows(**{name: walk[:-1], f"next_{name}": walk[1:]}))
    assert not [note for note in log.notes if "set point" in note]


def test_a_set_point_that_is_declared_constant_is_drafted_as_constant_although_it_moves(tmp_path: Path):
    stepped = np.repeat(RNG.uniform(-1, 1, 5), 10)
    np.savez(tmp_path / "log.npz", **rows(sp=stepped, next_sp=np.append(stepped[1:], stepped[-1])))
    mapping = {"state": {"x": "x", "sp": "sp"}, "next": {"x": "next_x", "sp": "next_sp"}, "action": {"0": "action"}}
    log = read_log(tmp_path / "log.npz", Options({**mapping, "reward": "reward", "constants": ["sp"]}))
    assert {c.name: c.kind for c in log.spec.coordinates} == {"x": "linear", "sp": "constant"}
    assert len(log.steps) == 50


def test_drafted_state_ranges_have_a_margin_and_action_ranges_none(tmp_path: Path):
    columns = rows()
    spec = drafted(tmp_path, **columns).spec
    low, high = (f(f(columns["x"]), f(columns["next_x"])) for f in (min, max))
    margin = 0.05 * (high - low)
    assert spec.coordinates[0].sampling == Uniform(low=low - margin, high=high + margin)
    assert spec.action == BoxAction(low=(columns["action"].min(),), high=(columns["action"].max(),))


def test_an_action_of_whole_numbers_is_drafted_as_discrete(tmp_path: Path):
    spec = drafted(tmp_path, **rows(action=np.arange(50) % 3)).spec
    assert spec.action == DiscreteAction(n=3)


def test_without_a_reward_column_a_zero_reward_is_drafted(tmp_path: Path):
    columns = rows()
    del columns["reward"]
    log = drafted(tmp_path, **columns)
    assert isinstance(log.spec.reward, DeclaredReward)
    assert any(note.startswith("reward: no column") for note in log.notes)


def test_terminated_log_episodes_give_a_drafted_learned_termination(tmp_path: Path):
    ended = np.arange(50) % 10 == 9
    assert drafted(tmp_path, **rows(terminated=ended)).spec.termination == "learned"


def test_a_start_value_equal_in_all_episodes_is_drafted_as_fixed(tmp_path: Path):
    columns = rows(episode=np.arange(50) // 10)
    columns["x"][::10] = 1.0
    spec = drafted(tmp_path, **columns).spec
    assert (spec.start["x"], spec.time_limit) == (Fixed(value=1.0), 10)


def test_an_outlier_in_the_log_is_reported_in_the_draft(tmp_path: Path):
    columns = rows()
    columns["next_x"][7] = 500.0
    assert any("1 step ends far from the others, up to 500" in note for note in drafted(tmp_path, **columns).notes)


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"action": np.ones(50)}, "expected an action '0' that varies, got only 1"),
        ({"x": np.ones(50), "next_x": np.ones(50)}, "expected at least one state that changes"),
    ],
)
def test_drafting_from_a_log_without_variation_is_refused(tmp_path: Path, changes, says: str):
    with pytest.raises(UnusableLog, match=says):
        drafted(tmp_path, **rows(**changes))


def test_log_rows_that_contradict_the_declared_termination_are_set_aside(tmp_path: Path):
    from surrogym_shared.spec import EnvironmentSpec, Inequality, Term

    columns = rows(terminated=np.zeros(50))
    spec = drafted(tmp_path, **columns).spec
    ends = ((Inequality(term=Term.linear(x=1), relation=">", value=2.0),),)
    fields = spec.model_dump() | {"termination": ends}
    columns["next_x"][:3], columns["terminated"][:2] = (3.0, 0.0, 3.0), 1
    np.savez(tmp_path / "log.npz", **columns)
    log = read_log(tmp_path / "log.npz", Options(spec=EnvironmentSpec.model_validate(fields)))
    told = dict(log.rejected)
    assert told[2] == "terminated: expected 0, as no declared termination holds at the next state, got 1"
    assert told[3] == "terminated: expected 1, as a declared termination holds at the next state, got 0"
    assert 1 not in told


def test_a_drafted_specification_starts_episodes_at_logged_states(tmp_path: Path):
    columns = rows()
    alone = drafted(tmp_path, **columns).spec
    assert len(alone.starts) == 50, "a single episode: any state of it"
    assert {start[0] for start in alone.starts} == set(columns["x"].tolist())
    many = drafted(tmp_path, **columns, episode=np.arange(50) // 5).spec
    assert [start[0] for start in many.starts] == columns["x"][::5].tolist()


def test_without_a_budget_leaving_the_range_costs_the_worst_logged_reward(tmp_path: Path):
    columns = rows()
    np.savez(tmp_path / "log.npz", **columns)
    assert read_log(tmp_path / "log.npz").spec.outside_reward == columns["reward"].min()
    assert read_log(tmp_path / "log.npz", Options(budget=20)).spec.outside_reward is None


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"x": 1e13}, "x: expected values of at most 1e.12 in size"),
        ({"action": 1e13}, "the action '0': expected values of at most 1e.12 in size"),
        ({"reward": 1e13}, "the reward: expected values of at most 1e.12 in size"),
        ({"x": 1e-300}, "x: expected values that differ by 1e-12 or more"),
        ({"action": 1e-300}, "the action '0': expected values that differ by 1e-12 or more"),
    ],
)
def test_drafting_from_a_log_with_too_large_or_small_numbers_is_refused(
    tmp_path: Path, changes: dict[str, float], says: str
):
    columns = rows()
    del columns["next_x"]
    with pytest.raises(UnusableLog, match=says):
        drafted(tmp_path, **columns | {name: factor * columns[name] for name, factor in changes.items()})


def test_a_draft_that_would_be_an_invalid_specification_is_refused(tmp_path: Path):
    name = "a" * 62  # cos(name) is longer than a name may be
    angle = np.remainder(np.arange(50) * 0.3, 2 * math.pi)
    with pytest.raises(UnusableLog, match="no valid specification can be drafted from the log: name: "):
        drafted(tmp_path, **{name: angle, "action": rows()["action"]})


@pytest.mark.parametrize("name", ["cls", "self"])
def test_a_drafted_coordinate_can_have_any_column_name(tmp_path: Path, name: str):
    columns = rows()
    log = drafted(tmp_path, **{name: columns["x"], "action": columns["action"], "reward": columns["reward"]})
    assert log.spec.coordinate_names == (name,)


def test_start_values_that_differ_by_rounding_are_drafted_as_fixed(tmp_path: Path):
    columns = rows(episode=np.arange(50) // 10)
    columns["x"][::10] = 1.0 + 1e-15 * np.arange(5)
    assert isinstance(drafted(tmp_path, **columns).spec.start["x"], Fixed)
