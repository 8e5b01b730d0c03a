"""Models beside a prior: a rough simulator saves samples, a wrong one costs none, and every computation agrees."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from support.hinge import Backwards, Real, Stiff, Textbook, hinge_spec, steps_of
from support.predictions import WAYS, check_compiled
from surrogym_server.convert import definition_from_spec
from surrogym_server.environment.points import Points
from surrogym_server.environment.samples import Samples
from surrogym_server.errors import InvalidInput
from surrogym_server.models.files import from_bytes, to_bytes
from surrogym_server.models.gaussian_process.codec.model import GaussianProcessCodec
from surrogym_server.models.gaussian_process.family import GaussianProcesses
from surrogym_server.models.gaussian_process.learning import prior
from surrogym_server.models.gaussian_process.model import GaussianProcessModel
from surrogym_server.models.gaussian_process.prediction.output_model import OutputModel
from surrogym_shared.nouns import RealSteps

HINGE = definition_from_spec(hinge_spec())


def samples(plant: Textbook, count: int, seed: int = 0) -> Samples:
    return Samples.of(RealSteps.of(steps_of(plant, count, seed), "manual"))


def learned(of: Samples, prior: GaussianProcessModel | None = None) -> GaussianProcessModel:
    family = GaussianProcesses()
    made = (family.learn(HINGE, of) if prior is None else family.learn_beside(prior, HINGE, of)).model
    assert isinstance(made, GaussianProcessModel)
    return made


@pytest.fixture(scope="module")
def textbook() -> GaussianProcessModel:
    return learned(samples(Textbook(), 80, seed=1))


def speed_error(model: GaussianProcessModel, plant: Textbook) -> float:
    """Root mean square error of the speed's change, as a share of its standard deviation."""
    test = samples(plant, 200, seed=99)
    change = (test.q_next - test.q)[:, 1]
    off = model.transition(test.q, test.u).q_next[:, 1] - test.q_next[:, 1]
    return float(off.square().mean().sqrt() / change.std())


@pytest.mark.parametrize(("plant", "most"), [(Real, 0.6), (Stiff, 1.0)])
def test_a_rough_prior_model_reduces_the_error_at_equal_samples(textbook, plant, most):
    few = [samples(plant(), 12, seed=seed) for seed in (3, 4, 5)]
    beside, alone = ([learned(one, *prior) for one in few] for prior in ((textbook,), ()))
    errors = [sum(speed_error(model, plant()) for model in models) for models in (beside, alone)]
    assert errors[0] < most * errors[1]


def test_the_description_of_an_output_tells_that_it_uses_the_prior(textbook):
    beside = learned(samples(Real(), 12, seed=3), textbook)
    assert beside.transitions[1].size_with_prior is not None
    assert beside.structures[1].startswith("prior + ")
    assert beside.description["prior"]["samples"] == 80


def test_with_a_correct_prior_model_the_uncertainty_is_near_zero(textbook):
    beside, test = learned(samples(Textbook(), 6, seed=3), textbook), samples(Textbook(), 50, seed=9)
    found = beside.transition(test.q, test.u, stds=True)
    assert found.std is not None
    assert float(found.std[:, 1].max()) < 0.01 * float(beside.scales[1])
    assert speed_error(beside, Textbook()) < 0.01


def test_a_wrong_prior_model_is_ignored_once_samples_contradict_it(textbook):
    wrong = learned(samples(Backwards(), 80, seed=1))
    many = samples(Real(), 30, seed=3)
    beside, alone = learned(many, wrong), learned(many)
    assert speed_error(beside, Real()) <= 1.1 * speed_error(alone, Real())


@pytest.mark.parametrize(("alone", "uses"), [(-1.0, True), (0.2, True), (0.5, False)])
def test_an_output_is_learned_without_the_prior_only_if_samples_contradict_it_by_a_margin(alone, uses, monkeypatch):
    """Ten left-out samples are likelier without the prior by a log factor of 2, or of 5."""
    scores = {prior.BESIDE: 0.0, "": alone}
    found = learned(samples(Real(), 10, seed=3)).transitions[1]

    def learn(name: str, target: torch.Tensor) -> OutputModel:
        return replace(found, name=name, scale=math.exp(-scores[prior.BESIDE if prior.BESIDE in name else ""]))

    monkeypatch.setattr(prior, "log_density", lambda output: -math.log(output.scale))
    every, target = torch.ones(10, dtype=torch.bool), torch.arange(10.0)
    chosen = prior.better_of(learn, "speed", target, torch.zeros(10), every)
    assert (chosen.size_with_prior is not None) == uses


def test_output_scales_do_not_depend_on_the_prior(textbook):
    few = samples(Real(), 8, seed=3)
    torch.testing.assert_close(learned(few, textbook).scales[:2], learned(few).scales[:2])


def test_leave_one_out_errors_with_a_prior_are_in_output_units(textbook):
    beside = learned(samples(Real(), 12, seed=3), textbook)
    assert 0 < beside.leave_one_out()[1].error < 0.2 * float(beside.scales[1])


def test_the_uncertainty_of_a_prior_model_of_few_steps_is_counted():
    beside = learned(samples(Textbook(), 4, seed=3), learned(samples(Textbook(), 12, seed=1)))
    test = samples(Textbook(), 200, seed=99)
    found = beside.transition(test.q, test.u, stds=True)
    assert found.std is not None
    off = (found.q_next - test.q_next)[:, 1].abs()
    assert float((off < 2 * found.std[:, 1]).double().mean()) > 0.5


@pytest.mark.parametrize("count", [12, 80])
@pytest.mark.parametrize("way", [way for way in WAYS if way != "in C"])
def test_compiled_steps_with_a_prior_equal_the_model(way, count):
    test = samples(Real(), 40, seed=5)
    prior = learned(samples(Textbook(), count, seed=1))
    check_compiled(learned(samples(Real(), 10, seed=3), prior), (test.q, test.u), way)


def test_a_model_with_a_prior_has_no_c_export(textbook):
    assert learned(samples(Real(), 10, seed=3), textbook).step_source() is None


def test_drawn_functions_with_a_prior_pass_through_the_samples(textbook):
    of = samples(Real(), 10, seed=3)
    beside = learned(of, textbook)
    paths = beside.draw(torch.randn(10, beside.path_size, generator=torch.Generator().manual_seed(1)).double())
    off = beside.transition_along(paths, of.q, of.u).q_next[:, 1] - of.q_next[:, 1]
    assert float(off.abs().max()) < 0.02 * float(beside.scales[1])


def test_drawn_functions_vary_as_much_as_deviations_that_count_an_uncertain_prior_model():
    beside = learned(samples(Textbook(), 4, seed=3), learned(samples(Textbook(), 12, seed=1)))
    test, count = samples(Real(), 12, seed=9), 1_000
    paths = beside.draw(torch.randn(count, beside.path_size, generator=torch.Generator().manual_seed(1)).double())
    drawn = [
        beside.transition_along(paths, q.expand(count, -1), u.expand(count, -1)).q_next[:, 1].std()
        for q, u in zip(test.q, test.u, strict=True)
    ]
    stated = beside.transition(test.q, test.u, stds=True).std
    assert stated is not None
    assert float((torch.stack(drawn) / stated[:, 1]).mean()) == pytest.approx(1, abs=0.2)


def test_a_stored_model_contains_its_prior(textbook):
    beside = learned(samples(Real(), 8, seed=3), textbook)
    again = from_bytes(HINGE, to_bytes(beside))
    test = samples(Real(), 20, seed=5)
    assert isinstance(again, GaussianProcessModel)
    assert again.prior is not None
    torch.testing.assert_close(again.means(test.q, test.u), beside.means(test.q, test.u), rtol=0, atol=0)


def test_a_stored_model_without_its_required_prior_is_refused(textbook):
    codec = GaussianProcessCodec()
    stored = codec.encode(learned(samples(Real(), 8, seed=3), textbook))
    with pytest.raises(InvalidInput, match="no prior"):
        codec.decode(HINGE, replace(stored, header=stored.header | {"prior": None}))


@pytest.mark.parametrize("size", [0.0, -1.0, math.inf, math.nan])
def test_a_stored_model_with_an_invalid_prior_size_is_refused(textbook, size):
    codec = GaussianProcessCodec()
    stored = codec.encode(learned(samples(Real(), 8, seed=3), textbook))
    stored.header["outputs"][1]["size_with_prior"] = size
    with pytest.raises(InvalidInput, match="size"):
        codec.decode(HINGE, stored)


def test_gaussian_processes_refuse_a_prior_that_is_not_a_gaussian_process_model():
    with pytest.raises(TypeError, match="Gaussian processes"):
        GaussianProcesses().learn_beside(object(), HINGE, samples(Real(), 4))  # type: ignore[arg-type]


class Bumped(Textbook):
    """A hinge that a magnet pushes near an angle of 1.5 rad, of which the textbook knows nothing."""

    def step_from(self, coordinates, action):
        step, force = (
            super().step_from(coordinates, action),
            0.3 * math.exp(-(((float(coordinates[0]) - 1.5) / 0.4) ** 2)),
        )
        angle, speed = step.next_coordinates
        angle = (angle + 0.1 * force + math.pi) % (2 * math.pi) - math.pi
        return replace(step, next_coordinates=(angle, speed + force))


def test_queries_go_where_the_plant_differs_from_the_prior_model(textbook):
    """The uncertainty alone is the same on both sides of the hinge."""
    known = samples(Bumped(), 20, seed=3)
    beside, places = learned(known, textbook), samples(Textbook(), 400, seed=5)
    points, near = Points(places.q, places.u), (places.q[:, 0] - 1.5).abs() < 0.8

    def value_near(model: GaussianProcessModel) -> float:
        """Value of a query near the magnet, as a multiple of that of a query anywhere."""
        outlook = model.outlook(points, points, points[:0])[1]
        assert outlook is not None
        value = outlook.reduction(torch.ones(400, dtype=torch.float64))
        return float(value[near].mean() / value.mean())

    plain = replace(beside, transitions=tuple(replace(one, size_with_prior=None) for one in beside.transitions))
    assert value_near(beside) > 1.2 * value_near(plain)
