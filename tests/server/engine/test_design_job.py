"""One round as a job: picklable, the same again for the same job, and a model that is complete in its bytes."""

import json
import pickle
from dataclasses import replace

import numpy as np
import pytest
import torch

from support.real_steps import answer, arrays, columns, join
from surrogym_sampler.original.classic import pendulum
from surrogym_server.convert import definition_from_spec
from surrogym_server.engine.design_job import DesignJob, DesignResult, errors_of_new, run_design_job
from surrogym_server.environment.samples import Samples
from surrogym_server.models.files import from_bytes
from surrogym_server.sampling.design import initial_queries
from surrogym_shared.nouns import Query
from surrogym_shared.spec import Design
from surrogym_shared.wire import Fidelity

SPEC = pendulum().model_copy(update={"design": Design(monte_carlo=64)})


@pytest.fixture(scope="module")
def job() -> DesignJob:
    definition = definition_from_spec(SPEC)
    steps = answer(SPEC, *arrays(initial_queries(definition, budget=20)))
    return DesignJob(definition, columns(steps), state={}, budget=20, target=0.999)


def test_a_pickled_design_job_gives_the_same_result(job):
    one, two = run_design_job(job), run_design_job(pickle.loads(pickle.dumps(job)))
    assert one.model == two.model
    assert one.fidelity == two.fidelity
    assert one.queries == two.queries
    assert one.data_hash == two.data_hash


def test_a_design_result_can_be_pickled_and_its_state_is_json(job):
    result = pickle.loads(pickle.dumps(run_design_job(job)))
    again = replace(job, state=json.loads(json.dumps(result.state)))
    assert run_design_job(again).state["round"] == 2


def test_the_model_bytes_and_fidelity_of_a_design_result_can_be_read_back(job):
    result = run_design_job(job)
    model = from_bytes(job.definition, result.model)
    assert model.samples == len(job.samples) == result.fidelity["samples"]
    assert model.digest == result.data_hash
    fidelity = Fidelity.model_validate(result.fidelity)
    assert [o.name for o in fidelity.outputs] == list(job.definition.outputs)
    assert fidelity.confidence_index == min(o.confidence_index for o in fidelity.outputs)
    assert fidelity.outputs[0].structure.startswith("squared exponential")


def test_the_queries_of_a_design_job_are_inside_the_sampling_range(job):
    result = run_design_job(replace(job, extra_queries=4))
    q, u = arrays(result.queries)
    assert (q.shape[1:], u.shape[1:]) == ((2,), (1,))
    assert (q.abs() <= torch.tensor([torch.pi, 8])).all()
    assert (u.abs() <= 2).all()


def test_a_design_job_uses_pending_queries_and_visited_states(job):
    hungry = replace(job, budget=len(job.samples) + 2, state={"round": 1, "usual": [1e-12] * 3})
    assert len(run_design_job(hungry).queries) == 2
    pending = replace(hungry, pending=(Query.step((1.0, 1.0), (0.0,)),))
    assert len(run_design_job(pending).queries) == 1
    visited = replace(hungry, occupancy=np.random.default_rng(0).normal([1, -3], [0.5, 1.5], (100, 2)))
    assert run_design_job(visited).queries != run_design_job(hungry).queries


def answered(job: DesignJob, result: DesignResult) -> DesignJob:
    """The job of the next round, with the answers to the queries of the last one."""
    steps = answer(SPEC, *arrays(result.queries))
    samples = columns(join(Samples.of(job.samples), steps))
    return replace(job, samples=samples, state=json.loads(json.dumps(result.state)), previous=result.model)


def surprised(job: DesignJob) -> list[int]:
    """How many errors of new samples a round has for each output."""
    return [len(errors) for errors in errors_of_new(job, Samples.of(job.samples))]


def test_errors_of_new_samples_are_those_of_the_model_of_the_previous_round(job):
    """No answer of this design ends at a limit."""
    assert errors_of_new(job, Samples.of(job.samples)) == ()
    first = run_design_job(replace(job, extra_queries=3))
    following = answered(job, first)
    answers = Samples.of(following.samples).at(torch.arange(len(job.samples), len(following.samples)))
    model = from_bytes(job.definition, first.model)
    expected = answers.q_next - answers.q - model.means(answers.q, answers.u)[:, :2]
    errors = errors_of_new(following, Samples.of(following.samples))
    np.testing.assert_allclose(np.array(errors)[:2].T, expected.numpy(), atol=1e-9)


def test_a_previous_model_changes_neither_model_nor_queries_of_a_design_that_was_not_ready(job):
    following = answered(job, run_design_job(replace(job, extra_queries=3)))
    one, other = (run_design_job(replace(following, extra_queries=2, previous=p)) for p in (following.previous, None))
    assert (one.model, one.verdict, one.queries) == (other.model, other.verdict, other.queries)


def test_logged_samples_and_unusable_previous_models_give_no_errors_of_new_samples(job):
    following = answered(job, run_design_job(replace(job, extra_queries=3)))
    purpose = (*following.samples.purpose[:-1], "logged")
    new = len(following.samples) - len(job.samples)
    one_logged = replace(following, samples=replace(following.samples, purpose=purpose))
    assert surprised(one_logged) == [new - 1] * 3
    moved = replace(job.samples, coordinates=job.samples.coordinates + 0.01)
    other = run_design_job(replace(job, samples=moved)).model
    assert surprised(replace(following, previous=other)) == []
    assert surprised(replace(following, previous=b"damaged")) == []
