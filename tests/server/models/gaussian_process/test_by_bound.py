"""Sparse processes: exact with few samples, near to exact ones with many, sure of no more than they know, and small."""

from __future__ import annotations

from dataclasses import fields
from functools import cache
from typing import Any

import numpy as np
import pytest
import torch

from support.models import learn
from support.real_steps import random_steps
from support.steps_in_c import check_in_c
from surrogym_lab.unseen.machine import Array, Machine
from surrogym_sampler.original.classic import pendulum
from surrogym_server.convert import definition_from_spec
from surrogym_server.environment.samples import Samples, increments
from surrogym_server.errors import InvalidSpec
from surrogym_server.models.files import from_bytes, to_bytes
from surrogym_server.models.gaussian_process import GaussianProcesses
from surrogym_server.models.gaussian_process.learning.limits import with_samples
from surrogym_server.models.gaussian_process.learning.output_learner import OutputLearner
from surrogym_server.models.gaussian_process.model import GaussianProcessModel
from surrogym_server.models.gaussian_process.settings import Settings
from surrogym_server.models.registry import learner_of
from surrogym_server.plugins import Choice
from surrogym_shared import compiled
from surrogym_shared.spec import EnvironmentSpec, ModelChoice

NOISE = 0.02
SHORT_NAMES = ("sparse_gaussian_process", "Sparse_Gaussian_Process")


class Springs(Machine):
    """Three masses in a row between walls. Each reads its neighbours alone; the first is pushed, and their speeds are
    noisy."""

    ranges = {f"{kind}{i}": (-1, 1) for kind in ("x", "v") for i in range(3)}  # noqa: RUF012
    start = ranges

    def formula(self, q: Array, u: Array) -> tuple[Array, Array]:
        x, v = q[..., :3], q[..., 3:]
        walls = np.zeros_like(x[..., :1])
        stretch = np.diff(np.concatenate([walls, x, walls], -1), axis=-1)
        force = np.diff(stretch + 3 * stretch**3, axis=-1) - 0.2 * v
        force[..., 0] += 2 * u[..., 0]
        return np.concatenate([x + 0.1 * v, v + 0.1 * force], -1), -(x**2).sum(-1)


def designed(spec: EnvironmentSpec, family: str, **settings: int) -> EnvironmentSpec:
    chosen = ModelChoice(name=family, settings=settings)
    return spec.model_copy(update={"design": spec.design.model_copy(update={"model": chosen})})


def steps(count: int, seed: int, noise: float = 0.0) -> Samples:
    rng, machine = np.random.default_rng(seed), Springs()
    q, u = rng.uniform(-1, 1, (count, 6)), rng.uniform(-1, 1, (count, 1))
    after, pay = machine.formula(q, u)
    after[:, 3:] += noise * rng.normal(size=(count, 3))
    arrays = (torch.from_numpy(part) for part in (q, u, after, pay))
    return Samples(*arrays, torch.zeros(count, dtype=torch.bool))


@cache
def model(inducing: int = 120) -> GaussianProcessModel:
    definition = definition_from_spec(designed(Springs().spec(), "sparse_gaussian_process", inducing=inducing))
    found = learn(definition, steps(1_200, seed=0, noise=NOISE)).model
    assert isinstance(found, GaussianProcessModel)
    return found


def test_a_sparse_model_of_few_samples_equals_the_exact_model():
    spec = pendulum()
    samples = random_steps(spec, 40, seed=0)
    exact, sparse = (
        learn(definition_from_spec(designed(spec, family)), samples).model
        for family in ("gaussian_process", "sparse_gaussian_process")
    )
    unseen = random_steps(spec, 20, seed=1)
    ours, theirs = (m.transition(unseen.q, unseen.u, stds=True) for m in (sparse, exact))
    assert torch.equal(ours.q_next, theirs.q_next)
    assert torch.equal(ours.std, theirs.std)
    assert sparse.description == exact.description


def test_a_sparse_model_learns_dynamics_and_noise_with_few_inducing_points():
    found, unseen = model(), steps(500, seed=1)
    sizes = [len(o.posterior.y) for o in found.transitions if o.posterior is not None]
    assert max(sizes) <= 120
    off = found.means(unseen.q, unseen.u)[:, :-1] - increments(found.definition, unseen)
    assert float(off[:, 3:].square().mean().sqrt()) < 0.4 * NOISE
    assert float(off[:, :3].square().mean().sqrt()) < 1e-4
    assert found.noise_stds[3:6] == pytest.approx([NOISE] * 3, rel=0.1)


def test_prediction_intervals_of_a_sparse_model_have_their_coverage():
    found, unseen = model(), steps(2_000, seed=2)
    made = found.transition(unseen.q, unseen.u, stds=True)
    off = (made.q_next - unseen.q_next)[:, 3:]
    within = (off.abs() <= 1.645 * made.std[:, 3:]).double().mean()
    assert 0.8 < float(within) <= 1


def test_a_sparse_model_leaves_out_inputs_irrelevant_to_an_output():
    """The last mass' speed reads its neighbour, its own place and its own speed, of seven inputs."""
    assert model().transitions[5].feature_map.dropped == (0, 3, 4, 6)


def test_a_stored_sparse_model_predicts_the_same():
    found, unseen = model(), steps(20, seed=3)
    loaded = from_bytes(found.definition, to_bytes(found))
    assert torch.equal(loaded.means(unseen.q, unseen.u), found.means(unseen.q, unseen.u))


def test_drawn_functions_of_a_sparse_model_have_its_standard_deviations():
    found = model(20)
    unseen = steps(4, seed=4)
    noise = torch.randn(400, found.path_size, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    paths, made = found.draw(noise), found.transition(unseen.q, unseen.u, stds=True)
    for i in range(len(unseen)):
        drawn = found.transition_along(paths, unseen.q[i].expand(400, -1), unseen.u[i].expand(400, -1))
        torch.testing.assert_close(drawn.q_next[:, 3:].std(0), made.std[i, 3:], rtol=0.25, atol=1e-4)


def test_a_model_with_fewer_inducing_points_is_more_uncertain():
    unseen = steps(200, seed=5)
    few, many = (model(m).transition(unseen.q, unseen.u, stds=True).std for m in (20, 120))
    noises = [np.array(model(m).noise_stds[3:6]) for m in (20, 120)]
    assert (
        float(few[:, 3:].square().mean()) + (noises[0] ** 2).mean()
        > float(many[:, 3:].square().mean()) + (noises[1] ** 2).mean()
    )


def test_a_warm_started_sparse_model_is_as_accurate_as_a_fresh_one():
    definition, samples, unseen = model().definition, steps(1_200, seed=0, noise=NOISE), steps(500, seed=1)
    first = learn(definition, steps(600, seed=0, noise=NOISE))
    again = learn(definition, samples, first.warm).model
    errors = [
        float((m.means(unseen.q, unseen.u)[:, :-1] - increments(definition, unseen)).square().mean().sqrt())
        for m in (model(), again)
    ]
    assert errors[1] < 1.5 * errors[0]


def test_reconditioning_a_sparse_process_keeps_the_number_of_inducing_points():
    """As for an output that has met its limits."""
    output, rng = model().transitions[3], np.random.default_rng(0)
    assert output.posterior is not None
    x = torch.from_numpy(rng.uniform(-1.7, 1.7, (300, output.posterior.x.shape[1])))
    learner = OutputLearner(model().definition, Settings(inducing=30), {}, {})
    everything = torch.ones(300, dtype=torch.bool)
    again = with_samples(learner, output, output.mean(x), {output.feature_map: x}, everything).posterior
    assert again is not None
    assert again.sparse is not None
    assert (again.sparse.points, len(again.y)) == (300, 30)


def test_the_model_name_sparse_gaussian_process_is_an_alias_for_its_settings():
    chosen = [definition_from_spec(designed(pendulum(), name)).learning.model for name in SHORT_NAMES]
    learners = [learner_of(choice) for choice in chosen]
    assert learners[0] == learners[1] == GaussianProcesses(inducing=300)
    assert {choice.name for choice in chosen} == {"gaussian_process"}


def test_design_settings_of_gaussian_processes_apply_to_sparse_ones():
    spec = designed(Springs().spec(), "sparse_gaussian_process", inducing=50)
    chosen = spec.design.model_copy(update={"symmetry": "none", "preset": "paper"})
    learner = learner_of(definition_from_spec(spec.model_copy(update={"design": chosen})).learning.model)
    assert isinstance(learner, GaussianProcesses)
    assert (learner.symmetry, learner.kernel, learner.inducing) == ("none", "squared_exponential", 50)


@pytest.mark.skipif(not compiled.available(), reason="numba is not installed, or switched off")
def test_a_batch_divided_between_threads_gives_bit_equal_steps(monkeypatch):
    from surrogym_server.models.gaussian_process.prediction.compiled import step

    move, unseen = model().compiled(), steps(100, seed=6)
    assert move is not None
    noise = np.random.default_rng(0).normal(size=(100, 6))
    wanted: dict[str, Any] = {"process": None, "paths": None, "stds": True, "reward_std": True}
    whole = move(unseen.q.numpy(), unseen.u.numpy(), noise=noise, **wanted)
    monkeypatch.setattr(step, "SPLIT", 0)
    monkeypatch.setattr(torch, "get_num_threads", lambda: 3)
    divided = move(unseen.q.numpy(), unseen.u.numpy(), noise=noise, **wanted)
    for field in fields(whole):
        np.testing.assert_array_equal(getattr(divided, field.name), getattr(whole, field.name))


def test_the_exported_c_step_of_a_sparse_model_equals_the_model():
    unseen = steps(50, seed=6)
    check_in_c(model(), (unseen.q, unseen.u))


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"inducing": 9}, "inducing to be a whole number from 10 to 2000, got 9"),
        ({"inducing": 2_001}, "inducing to be a whole number from 10 to 2000"),
        ({"inducing": True}, "expected inducing to be a whole number, got True"),
        ({"inducing": -1}, "inducing to be a whole number from 10 to 2000, got -1"),
        ({"kernel": "matern"}, "expected the setting kernel to be one of"),
        ({"points": 3}, "inducing, got 'points'"),
    ],
)
def test_invalid_sparse_gaussian_process_settings_are_refused(settings, said):
    with pytest.raises(InvalidSpec, match=said):
        learner_of(Choice("gaussian_process", tuple(settings.items())))
