"""The step of a surrogate in C is the model's own, on every kind of environment.

Each mechanism of the Gaussian processes is tested with its own tests in tests/server/models."""

from __future__ import annotations

import pytest
import torch

from support.kinds import ENVIRONMENTS
from support.models import gaussian_processes
from support.real_steps import random_steps
from support.steps_in_c import check_in_c
from surrogym_server.convert import definition_from_spec
from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.environment.distributions import quantiles
from surrogym_server.testing.cases import model_cases

CASES = {f"case: {case}": case for case in model_cases("gaussian_process")}
POINTS = 100


def points(definition: EnvironmentDefinition) -> tuple[torch.Tensor, torch.Tensor]:
    """States of the sampling range, and actions."""
    generator = torch.Generator().manual_seed(0)
    p = torch.rand(POINTS, len(definition.coordinates), generator=generator, dtype=torch.float64)
    q = quantiles([c.sampling for c in definition.coordinates], p)
    share = torch.rand(POINTS, definition.action.size, generator=generator, dtype=torch.float64)
    if definition.action.nvec:
        return q, (share * torch.tensor(definition.action.nvec)).floor()
    low, high = map(torch.from_numpy, definition.action_limits)
    return q, low + share * (high - low)


@pytest.mark.parametrize("kind", [*CASES, *ENVIRONMENTS])
def test_the_exported_c_step_equals_the_models_step(kind):
    if kind in CASES:
        model = gaussian_processes(CASES[kind].definition, CASES[kind].samples)
    else:
        spec = ENVIRONMENTS[kind]()
        model = gaussian_processes(definition_from_spec(spec), random_steps(spec, 20, seed=0))
    check_in_c(model, points(model.definition))
