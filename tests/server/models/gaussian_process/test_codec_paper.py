"""A model that moves the observation, as preset ``paper`` does, is stored and served like any other."""

import torch

from surrogym_server.models.files import from_bytes, to_bytes
from surrogym_server.models.gaussian_process.model import GaussianProcessModel


def test_a_model_of_preset_paper_survives_storage(paper_model: GaussianProcessModel):
    loaded = from_bytes(paper_model.definition, to_bytes(paper_model))
    q = torch.tensor([[3.0, -1.0], [0.2, 4.0]], dtype=torch.float64)
    u = torch.tensor([[0.5], [-2.0]], dtype=torch.float64)
    assert torch.equal(loaded.transition(q, u).q_next, paper_model.transition(q, u).q_next)
    assert [o.name for o in loaded.transitions] == ["cos", "sin", "speed"]
