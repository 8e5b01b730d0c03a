"""Sessions step a model of several families as any other, in every variant."""

from __future__ import annotations

import numpy as np
import pytest

from support.selected import mixed_cases
from surrogym_server.local import LocalSurrogate
from surrogym_server.testing.cases import PENDULUM
from surrogym_shared.spec import EnvironmentSpec
from surrogym_shared.wire import OpenSession

SPEC = EnvironmentSpec.model_validate(PENDULUM | {"design": {"model": "selected"}})
(CASE, *_) = mixed_cases(("gaussian_process", "ensemble", "gaussian_process"), {"steps": 50})


@pytest.mark.parametrize(
    "chosen", [{}, {"variant": "probabilistic"}, {"variant": "pathwise"}, {"variant": "pathwise", "functions": 4}]
)
def test_lanes_of_a_composed_model_step(chosen: dict[str, object]) -> None:
    port = LocalSurrogate(SPEC, CASE.model)
    session = port.open(OpenSession.model_validate({"num_envs": 4, "seed": 0, "penalty": 1.0, **chosen})).id
    before = port.reset(session).observation
    for _ in range(5):
        made = port.step(session, np.ones((4, 1), dtype=np.float32))
        assert np.isfinite(made.reward).all()
    assert not np.array_equal(before, made.observation)
    port.close(session)
