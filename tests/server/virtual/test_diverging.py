"""A model that diverges gives finite numbers for ever: unbounded coordinates have a reach."""

import numpy as np
import torch

from support.models import learn
from surrogym_server.convert import definition_from_spec
from surrogym_server.environment.samples import Samples
from surrogym_server.virtual import VirtualSettings, create, reset, step
from surrogym_shared.spec import BoxAction, Coordinate, EnvironmentSpec, ObservationEntry, Term, Uniform

SPEC = EnvironmentSpec(
    coordinates=(Coordinate(name="x", sampling=Uniform(low=-1, high=1)),),
    observation=(ObservationEntry(name="x", term=Term.linear(x=1)),),
    action=BoxAction(low=(-1,), high=(1,)),
    start={"x": Uniform(low=0.1, high=1)},
)


def test_steps_of_a_diverging_model_stay_finite():
    rng = np.random.default_rng(0)
    q, u = torch.tensor(rng.uniform(-1, 1, (8, 1))), torch.tensor(rng.uniform(-1, 1, (8, 1)))
    samples = Samples(q, u, 1.3 * q + 0.1 * u, -q[:, 0].square(), torch.zeros(8, dtype=torch.bool))
    model, settings = learn(definition_from_spec(SPEC), samples).model, VirtualSettings(1)
    lanes, _ = reset(model.definition, settings, create(model.definition, settings, 0))
    for _ in range(600):
        lanes, transition = step(model, settings, lanes, np.ones((1, 1)))
        assert np.isfinite(transition.observation).all()
        assert np.isfinite(transition.reward).all()
    assert transition.observation[0, 0] > 1e5
