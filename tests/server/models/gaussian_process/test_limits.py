"""Samples that ended at a limit are learned from where they help: those of another coordinate, and those of its own."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from support.models import gaussian_processes
from surrogym_server.convert import definition_from_spec
from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.environment.samples import Samples
from surrogym_server.errors import InvalidInput
from surrogym_server.gp import sparse
from surrogym_server.models.files import from_bytes, to_bytes
from surrogym_server.models.gaussian_process.censoring import stopped
from surrogym_server.models.gaussian_process.learning import learn as learning
from surrogym_server.models.gaussian_process.learning import limits
from surrogym_server.models.gaussian_process.prediction.output_model import OutputModel
from surrogym_shared.spec import Bounds, BoxAction, Coordinate, EnvironmentSpec, ObservationEntry, Term, Uniform

VALVE = 1.0  # what the pressure is kept below


def tank(**bounds: Bounds) -> EnvironmentDefinition:
    """A level and a pressure."""
    ranges = {"level": Uniform(low=-1, high=1), "pressure": Uniform(low=-1, high=1)}
    spec = EnvironmentSpec(
        coordinates=tuple(Coordinate(name=n, sampling=r, bounds=bounds.get(n)) for n, r in ranges.items()),
        observation=tuple(ObservationEntry(name=n, term=Term.linear(**{n: 1})) for n in ranges),
        action=BoxAction(low=(-1,), high=(1,)),
        start=ranges,
        time_limit=50,
    )
    return definition_from_spec(spec)


RELIEVED = tank(pressure=Bounds(high=VALVE))
TWO_SIDED = tank(pressure=Bounds(low=-3 * VALVE, high=VALVE))  # as a log's mapping declares limits


def steps(count: int, bent: bool, seed: int) -> Samples:
    """The pressure rises to the valve, and the level falls with it; at the valve it stays, if it is ``bent``."""
    p = 2 * torch.rand(count, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) - 1
    q, u = p[:, :2], p[:, 2:]
    pressure = (q[:, 1] + 0.5 + 0.3 * u[:, 0]).clamp_max(VALVE)
    fall = -0.3 * (2 * q[:, 1]).exp() * (1 + 0.2 * q[:, 0])
    level = q[:, 0] + torch.where((pressure >= VALVE) & torch.tensor(bent), 0.0, fall)
    reward = torch.zeros(count, dtype=torch.float64)
    return Samples(q, u, torch.stack([level, pressure], 1), reward, reward.bool())


def error(definition: EnvironmentDefinition, samples: Samples, test: Samples) -> float:
    off = gaussian_processes(definition, samples).transition(test.q, test.u).q_next[:, 0] - test.q_next[:, 0]
    return float(off.square().mean().sqrt())


@pytest.mark.parametrize(("bent", "share"), [(False, 0.1), (True, 0.5)])
def test_samples_at_the_limit_of_one_coordinate_improve_another_coordinates_model(monkeypatch, bent, share):
    samples, test = steps(40, bent, 5), steps(300, bent, 1)
    model = gaussian_processes(RELIEVED, samples)
    assert [output.past_limits for output in model.transitions] == [True, False]
    chosen = error(RELIEVED, samples, test)
    monkeypatch.setattr(learning, "past_limits", lambda _, output, *others: output)  # noqa: ARG005
    assert chosen < share * error(RELIEVED, samples, test)


def test_a_second_limit_that_no_sample_reaches_does_not_change_the_accuracy():
    """With two limits the pressure is a coordinate whose next value others may read."""
    samples, test = steps(40, False, 5), steps(300, False, 1)
    assert gaussian_processes(TWO_SIDED, samples).transitions[0].past_limits
    assert error(TWO_SIDED, samples, test) == pytest.approx(error(RELIEVED, samples, test), rel=0.1)


def test_an_output_driven_by_a_limited_speed_has_the_next_speed_as_input():
    found = steps(60, False, 5)
    follows = replace(found, q_next=torch.stack([found.q[:, 0] + 0.3 * found.q_next[:, 1], found.q_next[:, 1]], 1))
    output = gaussian_processes(TWO_SIDED, follows).transitions[0]
    assert output.feature_map.lead
    assert not output.past_limits


def test_a_sparse_process_decides_by_its_residuals_whether_to_use_samples_at_a_limit(monkeypatch):
    monkeypatch.setattr(sparse, "MAX_EXACT", 60)
    samples = steps(400, False, 5)
    compared: list[tuple[float, float]] = []

    def watched(output: OutputModel, target: Tensor, x: Tensor, learned: Tensor, every: Tensor) -> float:
        assert output.posterior.sparse is not None
        residuals = (target[every] - output.mean(x[every])).square().mean()
        compared.append((error_of(output, target, x, learned, every), float(residuals)))
        return compared[-1][0]

    error_of = limits._error
    monkeypatch.setattr(limits, "_error", watched)
    model = gaussian_processes(RELIEVED, samples)
    assert [output.past_limits for output in model.transitions] == [True, False]
    assert len(compared) == 2
    assert all(ours == pytest.approx(theirs) for ours, theirs in compared)


def test_without_samples_at_a_limit_the_model_treats_all_samples_alike():
    samples = steps(40, False, 5)
    free = ~stopped(RELIEVED, 1, samples.q_next)
    below = Samples(*(getattr(samples, name)[free] for name in Samples.__dataclass_fields__))
    assert not any(output.past_limits for output in gaussian_processes(RELIEVED, below).transitions)


def test_samples_at_an_outputs_own_limit_or_a_wall_are_not_used_to_learn_that_output():
    at_valve = torch.tensor([[0.0, VALVE], [0.0, 0.0]], dtype=torch.float64)
    assert stopped(RELIEVED, 1, at_valve).tolist() == [True, False]
    assert stopped(RELIEVED, 0, at_valve).tolist() == [False, False]
    assert stopped(TWO_SIDED, 0, at_valve).tolist() == [False, False]
    walled = tank(pressure=Bounds(low=-VALVE, high=VALVE, stops="level"))
    assert stopped(walled, 0, at_valve).tolist() == [True, False]


@pytest.mark.parametrize("bent", [False, True])
def test_a_stored_model_keeps_which_outputs_use_samples_at_limits(bent):
    model = gaussian_processes(RELIEVED, steps(20, bent, 0))
    loaded = from_bytes(RELIEVED, to_bytes(model))
    assert [o.past_limits for o in loaded.transitions] == [o.past_limits for o in model.transitions]
    candidate = torch.tensor([[0.0, VALVE]], dtype=torch.float64)
    assert bool(loaded._learns(0, candidate)[0]) == model.transitions[0].past_limits


def kettle(count: int, seed: int) -> Samples:
    """The pressure hardly rises below 0.2, and reaches the valve at once above it; the level stays."""
    p = 2 * torch.rand(count, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) - 1
    q, u = p[:, :2], p[:, 2:]
    pressure = (q[:, 1] + 0.1 * u[:, 0] + 4 * (20 * (q[:, 1] - 0.3)).sigmoid()).clamp_max(VALVE)
    reward = torch.zeros(count, dtype=torch.float64)
    return Samples(q, u, torch.stack([q[:, 0], pressure], 1), reward, reward.bool())


def test_a_step_that_ended_at_a_limit_is_predicted_to_reach_it():
    samples = kettle(30, 0)
    at_valve = samples.q_next[:, 1] >= VALVE
    predicted = gaussian_processes(RELIEVED, samples).transition(samples.q, samples.u).q_next[:, 1]
    assert 5 <= int(at_valve.sum()) <= 25
    assert float((VALVE - predicted[at_valve]).max()) < 0.01


def test_using_samples_at_a_limit_as_censored_improves_predictions_at_the_limit(monkeypatch):
    samples, test = kettle(30, 0), kettle(500, 1)

    def short_and_error() -> tuple[float, float]:
        """Share of the steps to the valve that are predicted to end below it, and the error of the other steps."""
        after = gaussian_processes(RELIEVED, samples).transition(test.q, test.u).q_next[:, 1]
        valve = test.q_next[:, 1] >= VALVE
        return float((after[valve] < VALVE - 0.05).double().mean()), float((after - test.q_next[:, 1])[~valve].std())

    short, error = short_and_error()
    monkeypatch.setattr(learning, "within_limits", lambda _, output, *others: output)  # noqa: ARG005
    short_without, error_without = short_and_error()
    assert short < 0.05 < 0.1 < short_without
    assert error < error_without


def test_a_prediction_beyond_the_limit_counts_as_zero_leave_one_out_error():
    """A point that observes a limit says that the value is at least as large."""
    pressure = gaussian_processes(RELIEVED, kettle(40, 5)).transitions[1]
    sides, posterior = torch.tensor(pressure.at_limit), pressure.posterior
    foretold, _ = posterior.leave_one_out()
    off = pressure.scale * pressure.amplitude(posterior.x) * (foretold - posterior.y)
    beyond = (sides == 1) & (off > 0)
    assert bool(beyond.any())
    expected = float(off.masked_fill(beyond, 0.0).square().mean().sqrt())
    assert pressure.leave_one_out().error == pytest.approx(expected, rel=1e-12)
    assert pressure.leave_one_out().error < 0.1 * replace(pressure, at_limit=()).leave_one_out().error


def test_a_stored_model_keeps_which_samples_ended_at_a_limit_and_malformed_lists_are_refused():
    model = gaussian_processes(RELIEVED, kettle(30, 0))
    loaded = from_bytes(RELIEVED, to_bytes(model))
    assert [o.at_limit for o in loaded.transitions] == [o.at_limit for o in model.transitions]
    assert [any(o.at_limit) for o in loaded.transitions] == [False, True]
    for sides in ((1, 0), (2,) * len(model.transitions[1].at_limit)):
        malformed = replace(model.transitions[1], at_limit=sides)
        stored = to_bytes(replace(model, transitions=(model.transitions[0], malformed)))
        with pytest.raises(InvalidInput, match="at_limit"):
            from_bytes(RELIEVED, stored)


def test_samples_at_a_correctly_predicted_limit_do_not_change_the_model(monkeypatch):
    samples = steps(30, False, 5)  # the pressure is linear below the valve
    assert bool((samples.q_next[:, 1] >= VALVE).any())
    model = gaussian_processes(RELIEVED, samples)
    monkeypatch.setattr(learning, "within_limits", lambda _, output, *others: output)  # noqa: ARG005
    assert to_bytes(gaussian_processes(RELIEVED, samples)) == to_bytes(model)


def test_a_lower_limit_is_learned_like_an_upper_limit():
    samples = kettle(30, 0)
    mirrored = Samples(-samples.q, -samples.u, -samples.q_next, samples.reward, samples.terminated)
    lower = tank(pressure=Bounds(low=-VALVE))
    above = gaussian_processes(RELIEVED, samples).transition(samples.q, samples.u).q_next
    below = gaussian_processes(lower, mirrored).transition(mirrored.q, mirrored.u).q_next
    torch.testing.assert_close(below, -above, rtol=1e-4, atol=1e-4)


def test_samples_stopped_by_a_wall_are_not_used_for_the_speed():
    """At the wall the speed becomes 0, which is its lower limit as well."""
    ranges = {"place": Uniform(low=0, high=1), "speed": Uniform(low=0, high=1)}
    spec = EnvironmentSpec(
        coordinates=(
            Coordinate(name="place", sampling=ranges["place"], bounds=Bounds(low=0, high=1, stops="speed")),
            Coordinate(name="speed", sampling=ranges["speed"], bounds=Bounds(low=0)),
        ),
        observation=tuple(ObservationEntry(name=n, term=Term.linear(**{n: 1})) for n in ranges),
        action=BoxAction(low=(-1,), high=(1,)),
        start=ranges,
        time_limit=50,
    )
    p = torch.rand(40, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    q, u = p[:, :2], 2 * p[:, 2:] - 1
    speed = q[:, 1] + 0.3 * (3 * q[:, 0]).sin() * (1 + 0.1 * u[:, 0])
    place = q[:, 0] + 0.2 * speed
    at_wall = place >= 1
    q_next = torch.stack([place.clamp_max(1), torch.where(at_wall, 0.0, speed)], 1)
    reward = torch.zeros(40, dtype=torch.float64)
    model = gaussian_processes(definition_from_spec(spec), Samples(q, u, q_next, reward, reward.bool()))
    off = (model.transition(q, u).q_next - q_next)[~at_wall].abs().max()
    assert bool(at_wall.any())
    assert float(off) < 1e-3


def test_a_sparse_process_uses_samples_at_a_limit_as_censored_too(monkeypatch):
    """Nothing was seen between the cold, where the pressure hardly rises, and the valve."""
    monkeypatch.setattr(sparse, "MAX_EXACT", 100)
    every = kettle(500, 0)
    seen = (every.q[:, 1] < -0.2) | (every.q_next[:, 1] >= VALVE)
    samples = Samples(*(getattr(every, name)[seen] for name in Samples.__dataclass_fields__))
    at_valve = samples.q_next[:, 1] >= VALVE

    def short() -> float:
        model = gaussian_processes(RELIEVED, samples)
        assert model.transitions[1].posterior.sparse is not None
        return float((VALVE - model.transition(samples.q, samples.u).q_next[:, 1])[at_valve].max())

    assert short() < 0.05
    monkeypatch.setattr(learning, "within_limits", lambda _, output, *others: output)  # noqa: ARG005
    assert short() > 0.2
