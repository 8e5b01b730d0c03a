"""Test functions for the optional abilities of a model family. A family without an ability passes its tests."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch

from surrogym_server.environment.points import Points
from surrogym_server.models.abilities import (
    FunctionDraws,
    LearnedNoise,
    LeaveOneOut,
    Lookahead,
    PredictedSteps,
    RewardEdges,
    UncertainHyperparameters,
    offers,
)
from surrogym_server.sampling.confidence import stds
from surrogym_server.testing.cases import ModelCase, close

DRAWS = 400


def _draws(case: ModelCase) -> list[FunctionDraws]:
    """Return the objects that sample functions from the model's posterior: one with optimal and one with sampled
    hyperparameters. Each is left out if the model family lacks this ability."""
    plain, uncertain = offers(case.model, FunctionDraws), offers(case.model, UncertainHyperparameters)
    found = [] if plain is None else [plain]
    return found if uncertain is None else [*found, uncertain.uncertain_functions]


def a_drawn_function_is_one_function(case: ModelCase) -> None:
    """Check that a sampled function, given by its weights, returns the same step at the same point, whatever the other
    rows of the batch are."""
    for able in _draws(case):
        noise = case.noise(3, able.path_size)
        paths = able.draw(noise)
        assert paths.shape == (3, able.path_size)
        assert close(able.draw(noise[1:2])[0], paths[1])
        q, u = case.points.q[:1].expand(4, -1), case.points.u[:1].expand(4, -1)
        made = able.transition_along(paths[[0, 1, 0, 2]], q, u).q_next
        assert close(made[0], made[2])


def drawn_functions_scatter_as_the_stds_say(case: ModelCase) -> None:
    if (able := offers(case.model, FunctionDraws)) is None:
        return
    q, u = case.points.q[:1], case.points.u[:1]
    paths = able.draw(case.noise(DRAWS, able.path_size))
    made = able.transition_along(paths, q.expand(DRAWS, -1), u.expand(DRAWS, -1)).q_next[:, 1]
    said = float(stds(case.model, q, u)[0, 1])
    assert float(made.std()) < 2 * said + 1e-9
    assert float(made.std()) > said / 2 - 1e-9


def a_drawn_function_may_have_columns_beyond_its_own(case: ModelCase) -> None:
    """Check that columns beyond ``path_size`` are ignored in the weights of a sampled function. A session has such
    columns if its lanes follow models of different sizes."""
    for able in _draws(case):
        paths = able.draw(case.noise(2, able.path_size))
        wider = torch.cat([paths, torch.zeros(2, 3, dtype=torch.float64)], 1)
        q, u = case.points.q[:2], case.points.u[:2]
        assert torch.equal(able.transition_along(paths, q, u).q_next, able.transition_along(wider, q, u).q_next)


def leave_one_out_errors_are_there_for_every_output(case: ModelCase) -> None:
    if (able := offers(case.model, LeaveOneOut)) is not None:
        errors = able.leave_one_out()
        assert len(errors) == len(case.definition.outputs)
        for one in errors:
            assert math.isfinite(one.error)
            assert one.error >= 0
            assert 0 <= one.within_one <= one.within_two <= 1


def learned_noise_is_there_for_every_output(case: ModelCase) -> None:
    if (able := offers(case.model, LearnedNoise)) is not None:
        stds = able.noise_stds
        assert len(stds) == len(case.definition.outputs)
        assert all(math.isfinite(one) and one >= 0 for one in stds)


def an_outlook_begins_with_the_stds_and_an_answer_lowers_them(case: ModelCase) -> None:
    if (able := offers(case.model, Lookahead)) is None:
        return
    points, nothing = case.points, case.points[:0]
    said = stds(case.model, points.q, points.u)
    for column, output in enumerate(able.outlook(points, points[:8], nothing)):
        if output is None:
            continue
        assert torch.allclose(output.std, said[:, column], rtol=1e-4, atol=1e-8)
        after = output.observe(3).std
        assert bool((after <= output.std + 1e-12).all())
        if output.learns[3]:
            assert after[3] < output.std[3] or float(output.std[3]) == 0
        reduction = output.reduction(torch.full((8,), 1 / 8, dtype=torch.float64))
        assert reduction.shape == (len(points),)
        assert float(reduction.min()) >= 0


def what_is_assumed_is_as_what_is_observed(case: ModelCase) -> None:
    if (able := offers(case.model, Lookahead)) is None:
        return
    points, nothing = case.points, case.points[:0]
    pairs = zip(able.outlook(points, nothing, points[[4]]), able.outlook(points, nothing, nothing), strict=True)
    for assumed, begun in pairs:
        if assumed is not None and begun is not None:
            assert torch.allclose(assumed.std, begun.observe(4).std, rtol=1e-4, atol=1e-8)


def paths_tell_more_the_longer_they_are(case: ModelCase) -> None:
    if (able := offers(case.model, Lookahead)) is None:
        return
    steps = _paths(case, case.points[:12])
    weight = torch.ones(3, 4, dtype=torch.float64)
    for column in range(len(case.definition.outputs)):
        if (along := able.along(steps, column)) is not None:
            information = along.information(weight, 0.1)
            assert information.shape == along.std.shape == along.learns.shape == (3, 4)
            assert float(information.min()) >= 0
            assert float(information.diff(dim=1).min()) >= -1e-9


def steps_that_are_taken_lower_the_stds(case: ModelCase) -> None:
    if (able := offers(case.model, Lookahead)) is None:
        return
    taken = case.points[:4]
    q_next = case.model.transition(taken.q, taken.u).q_next
    model = able.as_if_answered(PredictedSteps(taken.q, taken.u, q_next))
    before, after = (stds(m, taken.q, taken.u) for m in (case.model, model))
    assert float(after.sum()) <= float(before.sum()) + 1e-9


def doubts_about_edges_are_probabilities_of_error(case: ModelCase) -> None:
    if (able := offers(case.model, RewardEdges)) is not None:
        for doubt in able.reward_edge_doubts(case.points.q, case.unseen.q_next):
            assert doubt.shape == (len(case.points),)
            assert 0 <= float(doubt.min()) <= float(doubt.max()) <= 0.5


def _paths(case: ModelCase, points: Points) -> PredictedSteps:
    """Return three paths of four steps each, made from twelve points and the model's predictions at them."""
    q_next = case.model.transition(points.q, points.u).q_next
    return PredictedSteps(*(tensor.reshape(3, 4, -1) for tensor in (points.q, points.u, q_next)))


LAWS_OF_ABILITIES: tuple[Callable[[ModelCase], None], ...] = (
    a_drawn_function_is_one_function,
    drawn_functions_scatter_as_the_stds_say,
    a_drawn_function_may_have_columns_beyond_its_own,
    leave_one_out_errors_are_there_for_every_output,
    learned_noise_is_there_for_every_output,
    an_outlook_begins_with_the_stds_and_an_answer_lowers_them,
    what_is_assumed_is_as_what_is_observed,
    paths_tell_more_the_longer_they_are,
    steps_that_are_taken_lower_the_stds,
    doubts_about_edges_are_probabilities_of_error,
)
