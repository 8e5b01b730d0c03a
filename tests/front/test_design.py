"""The design in this process asks what the server's asks, and keeps nothing of an answer that is refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import surrogym
from support import teaching
from support.server import ServerProcess
from surrogym_client.original.classic import cartpole, pendulum
from surrogym_client.original.gymnasium import GymnasiumEnvironment
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


def test_pendulum_is_known_after_a_few_real_steps():
    design = surrogym.Design(pendulum(), budget=30)
    asked = run(design)
    assert (design.phase, design.steps) == ("ready", len(asked))
    assert len(asked) <= 12
    assert design.fidelity["confidence_index"] >= design.target
    assert {query.purpose for query in asked} == {"initial", "adaptive"}


def test_it_asks_what_the_server_asks(server_process: ServerProcess):
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


def test_the_next_round_waits_for_the_answers_of_this_one():
    design = surrogym.Design(small())
    queries = [design.ask() for _ in range(INITIAL)]
    with pytest.raises(surrogym.QueriesOpen, match=r"the queries \[1, 2, 3, 4, 5\] first") as caught:
        design.ask()
    assert caught.value.ids == tuple(query.id for query in queries if query)


def test_a_query_without_an_answer_counts_against_the_budget():
    design = surrogym.Design(small(budget=INITIAL))
    real = GymnasiumEnvironment(design.spec)
    lost = design.ask()
    assert lost is not None
    design.give_up(lost)
    assert len(run(design, real)) == INITIAL - 1
    assert (design.phase, design.steps) == ("over_budget", INITIAL - 1)
    with pytest.raises(InvalidInput, match="expected an open query"):
        design.give_up(lost)


def test_a_round_that_is_given_up_is_followed_by_another_until_the_budget_is_spent():
    design = surrogym.Design(small())
    real = GymnasiumEnvironment(design.spec)
    while (query := design.ask()) is not None:
        if query.purpose == "initial":
            design.tell(query, real.step_from(np.array(query.coordinates), np.array(query.action)))
        else:
            design.give_up(query)
    assert (design.phase, design.steps) == ("over_budget", INITIAL)


def test_without_any_answer_nothing_can_be_fitted():
    design = surrogym.Design(small(budget=2))
    for query in (design.ask(), design.ask()):
        assert query is not None
        design.give_up(query)
    with pytest.raises(InvalidInput, match="a model needs at least 2 samples, got 0"):
        design.ask()


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"coordinates": [0.0]}, r"coordinates: expected \(n, 2\)"),
        ({"next_coordinates": [0.0, 0.0, 0.0]}, r"next_coordinates: expected \(n, 2\)"),
        ({"next_coordinates": [0.0, np.nan]}, "next_coordinates: expected finite numbers"),
        ({"action": [9.0]}, "got 9"),
        ({"reward": np.inf}, "reward: expected finite numbers"),
    ],
)
def test_a_step_that_can_not_be_is_refused_and_the_query_stays_open(change: dict[str, Any], said: str):
    design = surrogym.Design(small())
    query = design.ask()
    step = {"coordinates": query.coordinates, "action": query.action, "next_coordinates": [0.0, 0.0], "reward": 0.0}
    with pytest.raises(InvalidInput, match=said):
        design.tell(query, surrogym.RealStep(**step | change))
    assert design.steps == 0
    design.tell(query, surrogym.RealStep(**step))
    with pytest.raises(InvalidInput, match="expected an open query"):
        design.tell(query, surrogym.RealStep(**step))
    with pytest.raises(InvalidInput, match="expected 1 to 1 steps, got 0"):
        design.tell(design.ask(), [])


def test_more_can_be_asked_for_within_the_budget_where_a_policy_goes():
    design = surrogym.Design(pendulum(), budget=20)
    before = len(run(design))
    design.improve(2, np.zeros((50, 2)))
    assert len(run(design)) >= 2
    with pytest.raises(InvalidInput, match="which is what the budget has left, got 30"):
        design.improve(30)
    assert design.steps >= before + 2


def test_the_model_is_an_environment(done: surrogym.Design):
    env = surrogym.make(done)
    env.reset(seed=0)
    assert env.step(env.action_space.sample())[0].shape == (3,)
    envs = surrogym.make_vec(done.surrogate(), 4)
    assert envs.reset(seed=0)[0].shape == (4, 3)
    with pytest.raises(InvalidInput, match="expected a design with a model"):
        surrogym.make(surrogym.Design(small()))


def test_it_is_saved_and_goes_on(done: surrogym.Design, tmp_path: Path):
    done.save(tmp_path / "pendulum.surrogate", "pendulum")
    assert SurrogateFile.load(tmp_path / "pendulum.surrogate").name == "pendulum"
    assert surrogym.make(tmp_path / "pendulum.surrogate").reset(seed=0)[0].shape == (3,)
    again = surrogym.Design.load(tmp_path / "pendulum.surrogate", budget=BUDGET + 2)
    assert again.steps == done.steps
    run(again)
    assert again.phase in ("ready", "over_budget")
    assert again.steps <= BUDGET + 2


def test_where_no_state_can_be_set_it_asks_for_rollouts():
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
    with pytest.raises(InvalidInput, match=f"expected 1 to {len(steps)} steps, got {len(steps) + 1}"):
        design.tell(query, [*steps, steps[0]])
    design.tell(query, steps[:1])
    assert design.steps == 1


def test_a_budget_that_is_none_is_refused():
    with pytest.raises(InvalidInput, match="budget: expected at least 2 real steps, got 1"):
        surrogym.Design(pendulum(), budget=1)
