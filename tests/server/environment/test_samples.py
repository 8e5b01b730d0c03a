"""Targets of real steps: increments the short way round the circle, and which of them a bound has cut."""

from dataclasses import replace

import torch

from surrogym_server.environment.samples import Samples, increments, saturated


def samples(q: list[list[float]], q_next: list[list[float]]) -> Samples:
    n = len(q)
    at, to = (torch.tensor(rows, dtype=torch.float64) for rows in (q, q_next))
    return Samples(at, torch.zeros(n, 1), to, torch.zeros(n), torch.zeros(n, dtype=torch.bool))


def test_angle_increments_take_the_shorter_direction_round_the_circle(pendulum_definition):
    made = increments(pendulum_definition, samples([[3.1, 1.0], [-3.1, -1.0]], [[-3.1, 1.5], [3.1, -2.0]]))
    expected = torch.tensor([[2 * torch.pi - 6.2, 0.5], [6.2 - 2 * torch.pi, -1.0]], dtype=torch.float64)
    torch.testing.assert_close(made, expected)


def test_constant_coordinates_are_not_learned(pendulum_definition):
    angle, speed = pendulum_definition.coordinates
    definition = replace(pendulum_definition, coordinates=(angle.model_copy(update={"kind": "constant"}), speed))
    torch.testing.assert_close(
        increments(definition, samples([[1.0, 1.0]], [[1.0, 3.0]])), torch.tensor([[2.0]], dtype=torch.float64)
    )


def test_samples_that_end_at_a_coordinate_bound_are_marked_saturated(pendulum_definition, mountain_car_definition):
    ends = torch.tensor([[0.0, 8.0], [0.0, -8.0], [0.0, 7.999], [0.0, 8.0 - 1e-12]], dtype=torch.float64)
    assert saturated(pendulum_definition, ends).tolist() == [True, True, False, True]
    ends = torch.tensor([[-1.2, 0.0], [0.0, 0.07], [0.5, 0.0]], dtype=torch.float64)
    assert saturated(mountain_car_definition, ends).tolist() == [True, True, False]


def test_different_samples_have_different_digests():
    one = samples([[0.0, 1.0]], [[0.0, 1.0]])
    same, other = samples([[0.0, 1.0]], [[0.0, 1.0]]), samples([[0.0, 1.0]], [[0.0, 1.0 + 1e-15]])
    assert one.digest == same.digest
    assert one.digest != other.digest
    assert len(one) == 1
