"""Leave-one-out errors: those of processes that never saw the point."""

from dataclasses import astuple, replace

import numpy as np
import pytest
import torch

from support.models import learn
from surrogym_server.environment.features import FeatureMap
from surrogym_server.gp import Hyperparameters, condition
from surrogym_server.gp.kernel import covariance
from surrogym_server.models.abilities import LeaveOneOutErrors
from surrogym_server.models.gaussian_process.prediction.output_model import OutputModel


def test_leave_one_out_errors_equal_those_of_processes_without_the_point(pendulum_definition, pendulum_samples):
    reward = learn(pendulum_definition, pendulum_samples).model.reward
    posterior, errors, stds = reward.posterior, [], []
    for i in range(len(posterior.y)):
        others = torch.arange(len(posterior.y)) != i
        k = posterior.factor @ posterior.factor.T
        weights = torch.linalg.solve(k[others][:, others], posterior.y[others])
        errors.append(float(k[i, others] @ weights - posterior.y[i]))
        known = k[i, others] @ torch.linalg.solve(k[others][:, others], k[others, i])
        stds.append(float((k[i, i] - known).sqrt()))
    expected = reward.scale * float(np.sqrt(np.mean(np.square(errors))))
    error, within_one, within_two = astuple(reward.leave_one_out())
    assert error == pytest.approx(expected, rel=1e-4)
    assert within_one == np.mean(np.abs(errors) <= stds)
    assert within_two == np.mean(np.abs(errors) <= 2 * np.array(stds))
    assert replace(reward, posterior=None).leave_one_out() == LeaveOneOutErrors(0.0, 1.0, 1.0)


def test_calibrated_deviations_cover_68_and_95_percent_of_leave_one_out_errors():
    """A process whose data are its own draws is right about its errors."""
    generator = torch.Generator().manual_seed(0)
    x = 4 * torch.rand(300, 1, generator=generator, dtype=torch.float64)
    hyper = Hyperparameters(torch.tensor([0.5]).double(), 1.0, 0.0, 0.0, 0.01)
    k = covariance(hyper, x, x) + 0.01 * torch.eye(300, dtype=torch.float64)
    y = torch.linalg.cholesky(k) @ torch.randn(300, generator=generator, dtype=torch.float64)
    drawn = OutputModel("y", FeatureMap(), condition(hyper, x, y), 0.0, 1.0)
    error, within_one, within_two = astuple(drawn.leave_one_out())
    assert error == pytest.approx(0.1, rel=0.1)
    assert within_one == pytest.approx(0.68, abs=0.05)
    assert within_two == pytest.approx(0.95, abs=0.025)
