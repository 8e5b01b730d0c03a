"""Systematic errors that a session adds to the predictions of its model."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from surrogym_server.errors import InvalidInput
from surrogym_server.virtual import Residual, step

INPUTS = 4  # cosine and sine of the angle, speed, torque
NONE = (0.0,) * (1 + INPUTS)


def residual(*rows: tuple[tuple[float, ...], ...]) -> Residual:
    """Of the exact pendulum: angle, speed and reward of each row of lanes."""
    return Residual((0.0,) * INPUTS, (1.0,) * INPUTS, rows)


def stepped(model, started, chosen: Residual | None, angles=(0.1, 0.1), torque: float = 0.5):
    settings, lanes = started(model, len(angles), residual=chosen)
    q = torch.stack([torch.tensor(angles, dtype=torch.float64), torch.zeros(len(angles), dtype=torch.float64)], -1)
    return step(model, settings, replace(lanes, q=q), np.full((len(angles), 1), torque))


def test_each_environment_gets_its_own_systematic_model_error(pendulum_model, started):
    errors = ((NONE, (0.3, 0, 0, 0, 0), (-2.0, 0, 0, 0, 0)), (NONE, NONE, NONE))
    plain, usual = stepped(pendulum_model, started, None, angles=(0.1, 0.1, 0.1))
    lanes, moved = stepped(pendulum_model, started, residual(*errors), angles=(0.1, 0.1, 0.1))
    assert (lanes.q - plain.q)[:, 1].tolist() == pytest.approx([0.3, 0, 0.3])
    assert (lanes.q - plain.q)[:, 0].tolist() == [0, 0, 0]
    assert (moved.reward - usual.reward).tolist() == pytest.approx([-2, 0, -2])


def test_a_systematic_model_error_can_depend_on_state_and_action(pendulum_model, started):
    by = ((NONE, (0, 0, 1.0, 0, 2.0), NONE),)
    plain, _ = stepped(pendulum_model, started, None)
    lanes, _ = stepped(pendulum_model, started, residual(*by))
    assert (lanes.q - plain.q)[:, 1].tolist() == pytest.approx([np.sin(0.1) + 2 * 0.5] * 2)


def test_states_stay_clipped_and_wrapped_after_systematic_model_errors(pendulum_model, started):
    far = (((4.0, 0, 0, 0, 0), (50.0, 0, 0, 0, 0), NONE),)
    lanes, _ = stepped(pendulum_model, started, residual(*far))
    assert lanes.q[:, 1].tolist() == [8.0, 8.0], "the pendulum's fastest"
    assert bool((lanes.q[:, 0].abs() <= np.pi).all())


@pytest.mark.parametrize(
    "wrong",
    [
        Residual((0.0,), (1.0,), (((0.0, 0.0),) * 3,)),
        Residual((0.0,) * INPUTS, (1.0,) * INPUTS, ((NONE, NONE),)),
        Residual((0.0,) * INPUTS, (0.0,) * INPUTS, ((NONE, NONE, NONE),)),
    ],
    ids=["inputs", "outputs", "scale"],
)
def test_systematic_model_errors_of_wrong_shape_are_refused(pendulum_model, wrong: Residual):
    with pytest.raises(InvalidInput, match="residual: expected"):
        wrong.check(pendulum_model.definition)
