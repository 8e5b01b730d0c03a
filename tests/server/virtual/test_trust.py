"""The trusted range, outside which an episode ends, and the process noise, which shakes the state."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from support.exact_models import ExactModel
from surrogym_server.virtual import step

STILL = np.zeros((3, 1))


@pytest.fixture
def unsure(pendulum_model) -> ExactModel:
    """Its reward deviates by its angle; every output's targets deviate by 1."""
    return replace(pendulum_model, std=0.5, reward_std=lambda q: q[:, 0].abs())


def stepped(model, started, angles, **chosen):
    settings, lanes = started(model, len(angles), **chosen)
    q = torch.stack([torch.tensor(angles, dtype=torch.float64), torch.zeros(len(angles), dtype=torch.float64)], -1)
    return step(model, settings, replace(lanes, q=q), np.zeros((len(angles), 1)))


def test_an_episode_is_truncated_where_any_outputs_uncertainty_exceeds_its_limit(unsure, started):
    _, transition = stepped(unsure, started, [0.1, 0.8, -2.0], trust=0.7)
    assert transition.untrusted.tolist() == transition.truncated.tolist() == [False, True, True]
    assert not transition.terminated.any()
    assert transition.std is None, "nobody asked for it"
    _, transition = stepped(unsure, started, [0.1, 0.2, 0.3], trust=0.4)
    assert transition.untrusted.all(), "the dynamics deviate by 0.5"


def test_the_limit_on_uncertainty_is_relative_to_the_deviation_of_the_samples(unsure, started):
    class Wider(ExactModel):
        @property
        def scales(self) -> torch.Tensor:
            return 10 * super().scales

    wider = Wider(**{name: getattr(unsure, name) for name in unsure.__dataclass_fields__})
    _, transition = stepped(wider, started, [0.1, 0.8, -2.0], trust=0.15)
    assert transition.untrusted.tolist() == [False, False, True]


def test_a_session_without_a_limit_on_uncertainty_reports_no_uncertain_states(unsure, started):
    _, transition = stepped(unsure, started, [0.1, 0.8, -2.0])
    assert transition.untrusted is None
    assert not transition.truncated.any()


def test_the_limit_on_uncertainty_truncates_episodes_of_the_particle_variant_too(unsure, started):
    chosen = {"variant": "probabilistic", "particles": 3, "trust": 0.4}
    _, transition = stepped(unsure, started, [0.1, 0.2, 0.3], **chosen)
    assert transition.untrusted.all()


def test_an_environment_truncated_by_the_limit_on_uncertainty_resets(unsure, started):
    lanes, transition = stepped(unsure, started, [0.1, 0.8, -2.0], trust=0.7, autoreset_mode="same_step")
    assert transition.final_lanes.tolist() == [1, 2]
    assert lanes.episode.tolist() == [0, 1, 1]


def test_process_noise_moves_the_state_with_its_learned_deviation(pendulum_model, started):
    shaken = replace(pendulum_model, process_std=0.02)
    settings, lanes = started(shaken, 2_000, process_noise=True)
    still, _ = step(shaken, replace(settings, process_noise=False), lanes, np.zeros((2_000, 1)))
    moved, _ = step(shaken, settings, lanes, np.zeros((2_000, 1)))
    kick = (moved.q - still.q).numpy()[(moved.q - still.q).abs().numpy().max(1) < 1]  # the others went once round
    np.testing.assert_allclose(kick.std(0), 0.02, rtol=0.1)
    assert abs(np.corrcoef(kick.T)[0, 1]) < 0.12
    again, _ = step(shaken, settings, lanes, np.zeros((2_000, 1)))
    np.testing.assert_array_equal(again.q, moved.q)


def test_process_noise_is_independent_for_each_particle(pendulum_model, started):
    shaken = replace(pendulum_model, process_std=0.02)
    chosen = {"variant": "probabilistic", "particles": 4, "spread": 0.0}
    settings, lanes = started(shaken, 3, process_noise=True, **chosen)
    lanes, _ = step(shaken, settings, lanes, STILL)
    assert len(np.unique(lanes.particles[..., 1])) == 12
