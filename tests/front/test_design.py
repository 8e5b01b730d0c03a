"""The design in this process asks what the server's asks, and keeps nothing of an answer that is refused."""

from __future__ import annotations

import copy
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import surrogym
from support import teaching
from support.server import ServerProcess
from surrogym_sampler.original.classic import cartpole, pendulum
from surrogym_sampler.original.gymnasium import GymnasiumEnvironment
from surrogym_server.errors import InvalidInput
from surrogym_shared.surrogate_file import SurrogateFile

INITIAL, BUDGET = 5, 8


def small(budget: int = BUDGET) -> surrogym.EnvironmentSpec:
    """Pendulum with few queries."""
    spec = pendulum()
    return spec.model_copy(update={"design": spec.design.model_copy(update={"initial": INITIAL, "budget": budget})})


def run(design: surrogym.Design, machine: GymnasiumEnvironment | None = None) -> list[surrogym.Query]:
    """Answer all that a design asks."""
    asked, real = [], machine or GymnasiumEnvironment(design.spec)
    while (query := design.ask()) is not None:
        design.tell(query, real.step_from(np.array(query.coordinates), np.array(query.action)))
        asked.append(query)
    return asked


@pytest.fixture(scope="module")
def done() -> surrogym.Design:
    design = surrogym.Design(small())
    run(design)
    return design


def test_an_in_process_design_learns_the_pendulum_in_at_most_12_real_steps():
    design = surrogym.Design(pendulum(), budget=30)
    asked = run(design)
    assert (design.phase, design.steps) == ("ready", len(asked))
    assert len(asked) <= 12
    assert design.fidelity["confidence_index"] >= design.target
    assert {query.purpose for query in asked} == {"initial", "adaptive"}


def test_an_in_process_design_asks_the_same_queries_as_the_server(server_process: ServerProcess):
    design = surrogym.Design(small())
    asked = run(design)
    with surrogym.Client(server_process.url) as client:
        teaching.teach(client, "the-same-design", pendulum(), BUDGET, INITIAL)
        queries = [query for query in client.queries("the-same-design") if query.status == "answered"]
        model = client.model("the-same-design")
    assert [(*query.coordinates, *query.action) for query in asked] == [
        (*q.coordinates, *q.actions[0]) for q in queries
    ]
    assert design.fidelity["confidence_index"] == model.fidelity.confidence_index


def test_asking_for_the_next_round_before_all_answers_raises():
    design = surrogym.Design(small())
    queries = [design.ask() for _ in range(INITIAL)]
    with pytest.raises(surrogym.QueriesOpen, match=r"the queries \[1, 2, 3, 4, 5\] first") as caught:
        design.ask()
    assert caught.value.ids == tuple(query.id for query in queries if query)


def test_a_query_that_was_given_up_counts_against_the_budget():
    design = surrogym.Design(small(budget=INITIAL))
    real = GymnasiumEnvironment(design.spec)
    lost = design.ask()
    assert lost is not None
    design.give_up(lost)
    assert len(run(design, real)) == INITIAL - 1
    assert (design.phase, design.steps) == ("unsure", INITIAL - 1)
    with pytest.raises(InvalidInput, match="expected an open query"):
        design.give_up(lost)


def test_giving_up_every_adaptive_query_ends_the_design_in_phase_unsure():
    design = surrogym.Design(small())
    real = GymnasiumEnvironment(design.spec)
    while (query := design.ask()) is not None:
        if query.purpose == "initial":
            design.tell(query, real.step_from(np.array(query.coordinates), np.array(query.action)))
        else:
            design.give_up(query)
    assert (design.phase, design.steps) == ("unsure", INITIAL)


def test_asking_after_all_queries_were_given_up_raises():
    design = surrogym.Design(small(budget=2))
    for query in (design.ask(), design.ask()):
        assert query is not None
        design.give_up(query)
    for _ in range(2):
        with pytest.raises(InvalidInput, match="a model needs at least 2 samples, got 0, and no query is left"):
            design.ask()
    steps = [surrogym.RealStep([0.1 * i, 0.0], [0.1], [0.1 * i, 0.1], -0.1 * i) for i in range(4)]
    design.tell(None, steps)
    assert design.ask() is None
    assert design.phase == "over_budget"


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"coordinates": [0.0]}, r"coordinates: expected shape \(n, 2\)"),
        ({"next_coordinates": [0.0, 0.0, 0.0]}, r"next_coordinates: expected shape \(n, 2\)"),
        ({"next_coordinates": [0.0, np.nan]}, "next_coordinates: expected finite numbers"),
        ({"action": [9.0]}, "got 9"),
        ({"reward": np.inf}, "reward: expected a finite number"),
        ({"reward": "x"}, "reward: expected numbers, got 'x'"),
        ({"reward": None}, "reward: expected numbers, got None"),
        ({"reward": 1e300}, "reward: expected .* 1e[+]12.*, got 1e[+]300"),
        (
            {"coordinates": [1e300, 0.0]},
            "coordinates: expected '.*' from .* to .*, got 1e[+]300",
        ),
        (
            {"next_coordinates": [0.0, 1e9]},
            "next_coordinates: expected 'speed' from -1.6e[+]07 to 1.6e[+]07, got 1e[+]09",
        ),
        ({"coordinates": ["a", "b"]}, "coordinates: expected numbers, got"),
        ({"coordinates": [1j, 0.0]}, "coordinates: expected numbers, got"),
        ({"coordinates": None}, "coordinates: expected numbers, got None"),
        ({"terminated": "no"}, "terminated: expected True or False, got 'no'"),
        ({"terminated": None}, "terminated: expected True or False, got None"),
        ({"truncated": 2}, "truncated: expected True or False, got 2"),
    ],
)
def test_an_invalid_real_step_is_refused_and_its_query_stays_open(change: dict[str, Any], said: str):
    design = surrogym.Design(small())
    query = design.ask()
    step = {"coordinates": query.coordinates, "action": query.action, "next_coordinates": [0.0, 0.0], "reward": 0.0}
    with pytest.raises(InvalidInput, match=said):
        design.tell(query, surrogym.RealStep(**step | change))
    assert design.steps == 0
    design.tell(query, surrogym.RealStep(**step))
    with pytest.raises(InvalidInput, match="expected an open query, got query 1, which was answered already"):
        design.tell(query, surrogym.RealStep(**step))
    second = design.ask()
    with pytest.raises(InvalidInput, match="expected 1 step, got 0"):
        design.tell(second, [])
    with pytest.raises(InvalidInput, match=r"expected a RealStep, or a list of them, got 1"):
        design.tell(second, (1, 2))
    assert design.steps == 1


def test_a_real_step_with_the_largest_accepted_values_can_be_fitted():
    """What can't be fitted is refused when it is told: no later ``ask`` could mend it."""
    design, real = surrogym.Design(small()), GymnasiumEnvironment(small())
    design.tell(None, surrogym.RealStep([0.0, 1.6e7], [0.0], [0.0, -1.6e7], 1e12))
    while (query := design.ask()) is not None and query.purpose == "initial":
        design.tell(query, real.step_from(np.array(query.coordinates), np.array(query.action)))
    assert design.fidelity


@pytest.mark.parametrize("spec", [small(), pendulum()])
def test_answering_a_query_of_another_design_is_refused(spec: surrogym.EnvironmentSpec):
    """Also one that is equal: the other design's machine may be another, and its query would stay open."""
    design, other = surrogym.Design(small()), surrogym.Design(spec)
    mine, theirs = design.ask(), other.ask()
    assert mine is not None
    assert theirs is not None
    step = surrogym.RealStep(theirs.coordinates, theirs.action, [0.0, 0.0], 0.0)
    for refused in (design.tell, lambda query, _: design.give_up(query)):
        with pytest.raises(InvalidInput, match="got query 1, which belongs to another design"):
            refused(theirs, step)
    with pytest.raises(InvalidInput, match=r"expected a Query .*, got str"):
        design.tell("x", step)  # type: ignore[arg-type]
    design.give_up(mine)
    with pytest.raises(InvalidInput, match="got query 1, which was given up"):
        design.tell(mine, step)
    assert design.steps == 0


@pytest.mark.parametrize(
    ("options", "said"),
    [
        *[
            ({"budget": wrong}, "budget: expected a whole number from 2")
            for wrong in (1, 2.5, "20", True, np.nan, np.inf)
        ],
        *[
            ({"target": wrong}, "target: expected a number above 0.5")
            for wrong in (np.nan, -1, 0.5, 1, 2, "x", None, True)
        ],
        *[({"threads": wrong}, "threads: expected a whole number from 1") for wrong in (0, 1.5, 10**9, "1")],
    ],
)
def test_an_out_of_range_option_of_a_design_is_refused(options: dict[str, Any], said: str):
    if options == {"target": None}:
        assert surrogym.Design(small(), **options).target == small().design.target
        return
    with pytest.raises(InvalidInput, match=said):
        surrogym.Design(small(), **options)


def test_a_pickled_query_can_be_answered_by_its_design():
    design = surrogym.Design(small())
    query = pickle.loads(pickle.dumps(design.ask()))
    design.give_up(query)
    copied = copy.deepcopy(design)
    second = copied.ask()
    assert second is not None
    copied.give_up(second)


def test_a_design_of_an_invalid_specification_is_refused():
    with pytest.raises(InvalidInput, match="spec: expected an EnvironmentSpec, got dict"):
        surrogym.Design({})  # type: ignore[arg-type]


def test_a_design_accepts_numpy_numbers_as_options():
    assert surrogym.Design(small(), budget=np.int64(6), target=np.float64(0.9)).budget == 6


@pytest.mark.parametrize(
    ("steps", "visited", "said"),
    [
        (1.5, None, "steps: expected a whole number from 1 to"),
        (True, None, "steps: expected a whole number from 1 to"),
        (np.nan, None, "steps: expected a whole number from 1 to"),
        (1, [[np.nan, 0.0]], "visited: expected finite numbers"),
        (1, np.zeros((0, 2)), "visited: expected at least one state, got none"),
        (1, "x", "visited: expected numbers, got 'x'"),
        (1, [[1e308, 0.0]], "visited: expected '.*' from"),
    ],
)
def test_an_invalid_improve_request_changes_nothing(steps: Any, visited: Any, said: str):
    design = surrogym.Design(pendulum(), budget=20)
    before = (design._extra, design._visited)
    with pytest.raises(InvalidInput, match=said):
        design.improve(steps, visited)
    assert (design._extra, design._visited) == before


def test_the_method_improve_adds_queries_near_visited_states_within_the_budget():
    design = surrogym.Design(pendulum(), budget=20)
    before = len(run(design))
    design.improve(2, np.zeros((50, 2)))
    assert len(run(design)) >= 2
    with pytest.raises(InvalidInput, match="the rest of the budget, got 30"):
        design.improve(30)
    assert design.steps >= before + 2


def test_a_gymnasium_environment_can_be_made_from_a_design_with_a_model(done: surrogym.Design):
    env = surrogym.make(done)
    env.reset(seed=0)
    assert env.step(env.action_space.sample())[0].shape == (3,)
    envs = surrogym.make_vec(done.surrogate(), 4)
    assert envs.reset(seed=0)[0].shape == (4, 3)
    with pytest.raises(InvalidInput, match="expected a design with a model"):
        surrogym.make(surrogym.Design(small()))


def test_a_saved_design_can_be_loaded_and_continued(done: surrogym.Design, tmp_path: Path):
    done.save(tmp_path / "pendulum.surrogate", "pendulum")
    assert SurrogateFile.load(tmp_path / "pendulum.surrogate").name == "pendulum"
    assert surrogym.make(tmp_path / "pendulum.surrogate").reset(seed=0)[0].shape == (3,)
    again = surrogym.Design.load(tmp_path / "pendulum.surrogate", budget=BUDGET + 2)
    assert again.steps == done.steps
    run(again)
    assert again.phase in ("ready", "over_budget")
    assert again.steps <= BUDGET + 2


@pytest.mark.parametrize(
    ("budget", "target", "phase"), [(30, None, "ready"), (INITIAL, None, "over_budget"), (30, 0.6, "ready")]
)
def test_an_ended_design_is_loaded_with_phase_budget_and_model(
    tmp_path: Path, budget: int, target: float | None, phase: str
):
    """Nothing is missing: no fit and no real step is needed to use its model, or to hear that it is known."""
    design = surrogym.Design(small(budget=20), budget=budget, target=target)
    run(design)
    assert design.phase == phase
    design.save(tmp_path / "it.surrogate", "it")
    again = surrogym.Design.load(tmp_path / "it.surrogate")
    assert (again.phase, again.steps, again.budget, again.target) == (phase, design.steps, budget, design.target)
    assert again.fidelity == design.fidelity
    assert surrogym.make(again).reset(seed=0)[0].shape == (3,)
    assert again.ask() is None
    assert again.phase == phase
    again.save(tmp_path / "again.surrogate", "it")
    assert (tmp_path / "again.surrogate").read_bytes() == (tmp_path / "it.surrogate").read_bytes()
    if phase == "ready":
        again.improve(1)
        assert again.ask() is not None


def test_an_unfinished_design_is_loaded_and_asks_further_queries(tmp_path: Path):
    design, real = surrogym.Design(small(budget=20), target=0.99999), GymnasiumEnvironment(small())
    while (query := design.ask()) is not None and query.purpose == "initial":
        design.tell(query, real.step_from(np.array(query.coordinates), np.array(query.action)))
    assert query is not None
    design.give_up(query)
    design.save(tmp_path / "it.surrogate", "it")
    again = surrogym.Design.load(tmp_path / "it.surrogate")
    assert (again.phase, again.steps, again.budget) == ("sampling", INITIAL, 19)
    assert again.fidelity == design.fidelity
    assert again.ask() is not None


def test_opening_a_missing_surrogate_file_raises_an_error_that_names_it(tmp_path: Path):
    for opened in (surrogym.make, surrogym.make_vec, surrogym.make_sb3, surrogym.Design.load):
        with pytest.raises(
            FileNotFoundError, match=r"expected a file that Design.save or surrogym export wrote, got no"
        ):
            opened(tmp_path / "nofile.surrogate")


def test_a_stable_baselines3_policy_trains_on_an_in_process_design(done: surrogym.Design, tmp_path: Path):
    from stable_baselines3 import PPO

    done.save(tmp_path / "it.surrogate", "it")
    policy = PPO("MlpPolicy", surrogym.make_sb3(done, num_envs=4), n_steps=16, batch_size=64, n_epochs=1)
    assert policy.learn(64).num_timesteps == 64
    assert surrogym.make_sb3(tmp_path / "it.surrogate", 2, time_limit=5).reset().shape == (2, 3)


def test_a_design_for_a_reset_only_environment_queries_rollouts_instead_of_steps():
    spec = cartpole().model_copy(update={"query": "rollout", "max_rollout": 10})
    spec = spec.model_copy(update={"design": spec.design.model_copy(update={"initial": 10})})
    design = surrogym.Design(spec, budget=10)
    query = design.ask()
    assert query is not None
    assert query.coordinates == ()
    steps = [
        surrogym.RealStep([0.1 * i, 0, 0, 0], action, [0.1 * (i + 1), 0, 0, 0], 1.0)
        for i, action in enumerate(query.actions)
    ]
    most = "1 step" if len(steps) == 1 else f"1 to {len(steps)} steps"
    with pytest.raises(InvalidInput, match=f"expected {most}, got {len(steps) + 1}"):
        design.tell(query, [*steps, steps[0]])
    design.tell(query, steps[:1])
    assert design.steps == 1


def test_a_design_with_an_invalid_budget_is_refused():
    with pytest.raises(InvalidInput, match="budget: expected a whole number from 2 to 100000, got 1"):
        surrogym.Design(pendulum(), budget=1)


def test_passing_an_environment_instead_of_its_specification_is_refused_with_a_hint():
    class Machine:
        def spec(self) -> None: ...

    with pytest.raises(InvalidInput, match=r"got Machine: give Machine\.spec\(\)"):
        surrogym.Design(Machine())  # type: ignore[arg-type]


def test_the_repr_of_a_design_shows_phase_and_real_steps():
    shown = repr(surrogym.Design(pendulum(), budget=20))
    assert "collecting" in shown
    assert "0 of 20 real steps" in shown
