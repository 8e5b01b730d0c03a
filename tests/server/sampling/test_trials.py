"""Every second round of a design by resets acts by a planner, whose actions are planned anew from measured states."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from support import limited
from support.models import learn
from support.real_steps import random_steps
from surrogym import Design
from surrogym_sampler import original
from surrogym_sampler.original.classic import cartpole
from surrogym_sampler.original.protocol import RolloutEnvironment
from surrogym_sampler.original.rollouts import answering, keeping_limits
from surrogym_server.convert import definition_from_spec
from surrogym_server.planning.planner import allows_planning
from surrogym_server.sampling.judging import judge_model
from surrogym_server.sampling.round import Round
from surrogym_server.sampling.rules import leave_to_trials, try_planner
from surrogym_server.sampling.state import DesignState, Request
from surrogym_shared.limits import past
from surrogym_shared.spec import EnvironmentSpec, with_history

STEPS = 30


@pytest.fixture(scope="module")
def spec() -> EnvironmentSpec:
    return EnvironmentSpec.model_validate({**cartpole().model_dump(), "query": "rollout"})


@pytest.fixture(scope="module")
def trial(spec: EnvironmentSpec) -> Round:
    samples = random_steps(spec, STEPS, seed=0)
    model = learn(definition_from_spec(spec), samples).model
    request, tolerances = Request(budget=100, target=0.95), (0.1,) * 5
    judgement = judge_model(model, samples, tolerances, request, DesignState())
    return Round(1, model, samples, request, judgement, tolerances, [0], continues=True, testing=False)


def test_every_second_round_is_a_rollout_that_is_planned_anew_for_a_third_of_the_samples(trial: Round):
    (query,) = try_planner(trial) or ()
    assert query.replan
    assert (query.kind, query.snapshot, query.steps) == ("rollout", None, STEPS // 3)
    assert try_planner(replace(trial, number=2)) is None
    assert try_planner(replace(trial, continues=False)) is None, "an ended design asks for no trial"


def test_a_trial_never_takes_more_steps_than_the_budget_has_left(trial: Round):
    tight = replace(trial, request=replace(trial.request, budget=STEPS + 2))
    (query,) = try_planner(tight) or ()
    assert query.steps == 2
    assert try_planner(replace(trial, request=replace(trial.request, budget=STEPS))) is None


def test_no_trial_is_asked_of_a_machine_for_which_nothing_can_be_planned(trial: Round, spec: EnvironmentSpec):
    steered = spec.model_copy(update={"limits": None, "observation": spec.observation[:2]})
    hidden = learn(definition_from_spec(steered), trial.samples).model
    assert allows_planning(trial.model)
    assert not allows_planning(hidden), "two of four coordinates can't be read from this observation"
    assert try_planner(replace(trial, model=hidden)) is None


def test_rollouts_that_are_planned_anew_keep_declared_limits():
    design, machine = Design(limited.SPEC), keeping_limits(answering(limited.PatientCart()))
    assert isinstance(machine, RolloutEnvironment)
    planned, reached = False, []
    while not planned and (query := design.ask()) is not None:
        acting, state, steps = design.acting(query), np.asarray(machine.begin(query.id)), []
        for number in range(query.steps):
            steps.append(machine.act(np.array(acting(number, state))))
            state = np.asarray(steps[-1].next_coordinates)
        design.tell(query, steps)
        planned = query.replan
        reached += [step.next_coordinates for step in steps]
    assert planned
    assert not past(limited.SPEC, np.array(reached)).any()


def test_a_design_plans_the_actions_of_a_trial_from_the_states_that_were_measured():
    machine = original.make("Pendulum-v1", access="reset", seed=0, budget=30)
    design, seen = Design(machine.spec()), []
    while (query := design.ask()) is not None and not query.replan:
        machine.begin(query.id)
        design.tell(query, [machine.act(np.array(action)) for action in query.actions])
    assert query is not None
    acting, state = design.acting(query), np.asarray(machine.begin(query.id))
    for number in range(query.steps):
        seen.append(machine.act(np.array(acting(number, state))))
        state = np.asarray(seen[-1].next_coordinates)
    design.tell(query, seen)
    taken = np.array([step.action for step in seen])
    assert not np.array_equal(taken, np.array(query.actions)), "the measured states differ from the expected ones"
    low, high = machine.spec().action.ranges[0]
    assert (low <= taken).all()
    assert (taken <= high).all()


def test_the_actions_of_any_other_query_are_its_own():
    design = Design(original.make("Pendulum-v1", access="reset", seed=0, budget=30).spec())
    query = design.ask()
    assert query is not None
    assert [design.acting(query)(i, [0.0, 0.0]) for i in range(query.steps)] == list(query.actions)


def test_a_design_in_python_leaves_no_steps_to_trials():
    plain = cartpole().model_copy(update={"query": "rollout"})
    spec = with_history(plain, changes=1, largest=dict.fromkeys(plain.coordinate_names, 1.0))
    assert spec.needs_trials
    left = []
    for definition in (definition_from_spec(spec), Design(spec)._definition):
        facts = SimpleNamespace(definition=definition, continues=True, testing=False, cost=1_000)
        left.append(leave_to_trials(facts))  # type: ignore[arg-type]
    assert left == [(), None]
