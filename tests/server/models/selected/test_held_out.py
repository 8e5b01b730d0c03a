"""What is held out, and how predictions of it are scored."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch.distributions import StudentT

from surrogym_server.environment.samples import Samples
from surrogym_server.models.selected.held_out import FEWEST, HeldOut, held_out
from surrogym_server.models.selected.scores import FLOOR, FREEDOM, horizons_of, scores
from surrogym_server.sampling.latin_hypercube import random_points
from surrogym_server.testing import ModelCase, model_cases

(CASE,) = (case for case in model_cases("gaussian_process", None, 60) if case.name == "declared reward")


def episodes(lengths: list[int]) -> Samples:
    """Steps of a model along episodes, one after the other."""
    q, u = random_points(CASE.definition, len(lengths), np.random.default_rng(0))
    steps = []
    for _ in range(max(lengths)):
        made = CASE.model.transition(q, u)
        steps.append((q, u, made.q_next, made.reward))
        q = made.q_next
    parts = (torch.stack(part, 1) for part in zip(*steps, strict=True))
    q, u, q_next, reward = (torch.cat([one[:n] for one, n in zip(part, lengths, strict=True)]) for part in parts)
    return Samples(q, u, q_next, reward, torch.zeros(len(q), dtype=torch.bool))


def rows(held: HeldOut | None) -> list[int]:
    assert held is not None
    return torch.cat([piece for fold in held.folds for piece in fold]).tolist()


def test_pieces_of_episodes_are_held_out_whole() -> None:
    held = held_out(CASE.definition, episodes([20] * 10))
    assert held is not None
    assert (held.kind, held.pieces, len(held.folds)) == ("trajectories", 10, 5)
    for fold in held.folds:
        for piece in fold:
            assert piece.tolist() == list(range(int(piece[0]), int(piece[0]) + 20))
            assert int(piece[0]) % 20 == 0
    assert sorted(rows(held)) == list(range(200)), "each is held out once"


def test_a_long_log_is_cut_and_a_part_of_it_is_enough() -> None:
    held = held_out(CASE.definition, episodes([900] * 6))
    assert held is not None
    assert (held.kind, held.pieces, len(held.folds)) == ("trajectories", 11, 1)
    assert len(rows(held)) == len(set(rows(held)))


def test_single_steps_are_held_out_where_there_are_no_trajectories() -> None:
    held = held_out(CASE.definition, CASE.samples)
    assert held is not None
    assert (held.kind, held.pieces, len(held.folds)) == ("steps", 60, 5)
    assert sorted(rows(held)) == list(range(60))


def test_too_few_samples_are_not_compared() -> None:
    assert held_out(CASE.definition, CASE.samples.at(torch.arange(FEWEST - 1))) is None


def test_horizons_are_as_long_as_the_longest_piece() -> None:
    assert horizons_of([torch.arange(1)]) == (1,)
    assert horizons_of([torch.arange(1), torch.arange(30)]) == (1, 5, 20)


def scored(case: ModelCase, samples: Samples) -> tuple[list[float], list[float]]:
    found = scores(case.model, samples, [torch.arange(0, 20), torch.arange(20, 40)], case.model.scales)
    return [float(one.density.mean()) for one in found[:-1]], [float(one.inside.mean()) for one in found[:-1]]


def test_a_model_that_is_right_has_the_best_score_and_a_wrong_one_a_worse() -> None:
    right = episodes([20, 20])
    best = float(StudentT(FREEDOM).log_prob(torch.zeros(()))) - np.log(FLOOR)
    density, inside = scored(CASE, right)
    assert density[1] == pytest.approx(best, abs=0.5)
    assert inside[1] == 1
    off = replace(right, q_next=right.q_next + 0.5 * CASE.model.scales[:2])
    wrong, outside = scored(CASE, off)
    assert wrong[1] < 0
    assert outside[1] < 0.1


def test_an_angle_is_compared_across_its_cut() -> None:
    right = episodes([20, 20])
    turned = replace(right, q_next=right.q_next + torch.tensor([2 * np.pi, 0.0]))
    assert scored(CASE, turned)[0] == pytest.approx(scored(CASE, right)[0], abs=1e-6)
