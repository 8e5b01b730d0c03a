"""How far back a process looks is chosen by evidence."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from safetensors.torch import load

from support.models import header_of, learn
from support.rail import SPEC, Rail
from surrogym_sampler.original.protocol import RealStep
from surrogym_sampler.original.rollouts import FromReset
from surrogym_server.convert import definition_from_spec
from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.environment.samples import Samples
from surrogym_server.errors import InvalidInput
from surrogym_server.models.files import from_bytes, to_bytes, with_checksum
from surrogym_server.models.gaussian_process.feature_maps import candidates
from surrogym_server.models.gaussian_process.model import GaussianProcessModel
from surrogym_shared.spec import with_history

LONGEST = 4
SPEC_WITH_PAST = with_history(SPEC, changes=2, actions=LONGEST, largest={"x": 0.1})


class Delayed(Rail):
    """A push moves the rail after a dead time."""

    def __init__(self, dead_steps: int) -> None:
        super().__init__()
        self.dead_steps = dead_steps

    def spec(self):
        return SPEC_WITH_PAST

    def reset(self, *, seed=None):
        self.pipe = [np.zeros(1)] * self.dead_steps
        return super().reset(seed=seed)

    def step(self, action):
        self.pipe.append(action)
        return super().step(self.pipe.pop(0))


@pytest.fixture(scope="module")
def definition() -> EnvironmentDefinition:
    return definition_from_spec(SPEC_WITH_PAST)


def walked(dead_steps: int) -> Samples:
    """Four rollouts of nine random pushes."""
    rng, machine = np.random.default_rng(dead_steps), FromReset(Delayed(dead_steps))
    steps: list[RealStep] = []
    for seed in range(4):
        machine.begin(seed)
        steps += [machine.act(rng.uniform(-1, 0.6, 1)) for _ in range(9)]
    rows = [[getattr(s, name) for s in steps] for name in ("coordinates", "action", "next_coordinates", "reward")]
    ends = torch.zeros(len(steps), dtype=torch.bool)
    return Samples(*(torch.tensor(np.array(row, dtype=np.float64)) for row in rows), ends)


@pytest.fixture(scope="module")
def model(definition: EnvironmentDefinition) -> GaussianProcessModel:
    return learn(definition, walked(2)).model


@pytest.mark.parametrize("dead_steps", range(LONGEST))
def test_the_selected_history_length_equals_the_dead_time_of_the_environment(definition, dead_steps):
    (moved,) = learn(definition, walked(dead_steps)).model.transitions
    assert moved.feature_map.history == dead_steps


def test_a_reward_that_depends_only_on_the_current_state_gets_history_length_zero(model):
    assert model.reward.feature_map.history == 0
    assert "history 0" in model.description["outputs"][-1]["inputs"]


def test_every_history_length_is_scored_and_the_best_feature_map_is_kept(model):
    (moved,) = model.transitions
    histories = [name for name, _ in moved.scores if "history" in name]
    assert len(histories) == LONGEST
    assert max(moved.scores, key=lambda score: score[1])[0] == str(moved.feature_map)


def test_without_lagged_coordinates_no_history_lengths_are_compared(pendulum_definition):
    assert {m.history for m in candidates(pendulum_definition, follows=True)} == {None}


def test_a_stored_model_keeps_its_history_length(definition, model):
    loaded = from_bytes(definition, to_bytes(model))
    assert loaded.transitions[0].feature_map == model.transitions[0].feature_map
    samples = walked(2)
    assert torch.equal(loaded.means(samples.q, samples.u), model.means(samples.q, samples.u))


def test_a_stored_model_with_an_invalid_history_length_is_refused(definition, model):
    data = to_bytes(replace(model))
    text = json.dumps(header_of(data))
    assert '"history": 2' in text
    for wrong in (str(LONGEST), "-1", '"2"'):
        other = text.replace('"history": 2', f'"history": {wrong}', 1)
        with pytest.raises(InvalidInput):
            from_bytes(definition, with_checksum(json.loads(other), load(data)))
