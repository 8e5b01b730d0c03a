"""Rewards that pay in one place alone are learned by their logarithms, and other rewards are not."""

from __future__ import annotations

import pytest
import torch

from support.models import gaussian_processes
from support.plane import Pay, drifting, plane
from support.steps_in_c import check_in_c
from surrogym_server.convert import definition_from_spec
from surrogym_server.environment.features import encode
from surrogym_server.errors import InvalidInput
from surrogym_server.models.files import from_bytes, to_bytes
from surrogym_server.models.gaussian_process.codec.model import GaussianProcessCodec
from surrogym_server.models.gaussian_process.feature_maps import reward_candidates
from surrogym_server.models.gaussian_process.learning.output_learner import OutputLearner
from surrogym_server.models.gaussian_process.learning.peaks import _account_of
from surrogym_server.models.gaussian_process.model import GaussianProcessModel
from surrogym_server.models.gaussian_process.settings import Settings
from surrogym_shared.spec import ModelChoice

CODEC = GaussianProcessCodec()
DEFINITION = definition_from_spec(plane())
PLACE = torch.tensor([0.3, -0.2], dtype=torch.float64)


def bump(q: torch.Tensor, _: torch.Tensor) -> torch.Tensor:
    return (-0.5 * ((q - PLACE) / 0.04).square().sum(-1)).exp()


def around(pay: Pay, model: GaussianProcessModel) -> torch.Tensor:
    """Errors (m,) of the reward near the place."""
    noise = torch.randn(200, 2, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    q, u = PLACE + 0.05 * noise, torch.zeros(200, 1, dtype=torch.float64)
    moved = model.transition(q, u)
    return moved.reward - pay(moved.q_next, u)


def without_peaks() -> GaussianProcessModel:
    design = plane().design.model_copy(
        update={"model": ModelChoice(name="gaussian_process", settings={"reward_peaks": False})}
    )
    return gaussian_processes(definition_from_spec(plane().model_copy(update={"design": design})), drifting(bump, 12))


def test_a_narrow_reward_peak_is_learned_from_small_rewards_around_it():
    samples = drifting(bump, 12)
    assert float(samples.reward.max()) < 0.05
    model = gaussian_processes(DEFINITION, samples)
    assert model.description["outputs"][-1]["learned"] == "log(reward)"
    assert float(around(bump, model).abs().max()) < 0.02
    assert float(around(bump, without_peaks()).abs().max()) > 0.5


def test_the_exported_c_step_reproduces_a_narrow_reward_peak():
    near = PLACE + 0.1 * torch.randn(50, 2, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    check_in_c(
        gaussian_processes(DEFINITION, drifting(bump, 12)), (near, torch.zeros(50, 1, dtype=torch.float64)), loose=True
    )


@pytest.mark.parametrize(
    ("pay", "learned"),
    [
        (lambda q, u: -bump(q, u), "log(-(reward))"),
        (lambda q, u: bump(q, u) - 1, "log(reward +1)"),
    ],
)
def test_a_negative_or_shifted_reward_peak_is_learned_too(pay, learned):
    model = gaussian_processes(DEFINITION, drifting(pay, 150))
    assert model.description["outputs"][-1]["learned"] == learned
    assert float(around(pay, model).abs().max()) < 0.1


def test_samples_with_exactly_zero_reward_do_not_hide_a_reward_peak():
    samples = drifting(lambda q, u: torch.where(bump(q, u) < 1e-40, 0.0, bump(q, u)), 60)
    assert int((samples.reward == 0).sum()) >= 5
    assert float(around(bump, gaussian_processes(DEFINITION, samples)).abs().max()) < 0.1


def test_zero_reward_samples_that_the_fit_predicts_do_not_change_its_score():
    """Samples that paid nothing, where the others foretell as little, had no say in it."""
    samples = drifting(lambda q, u: torch.where(bump(q, u) < 1e-40, 0.0, bump(q, u)), 60)
    maps = (feature_map for feature_map in reward_candidates(DEFINITION) if feature_map.after)
    inputs = {m: encode(DEFINITION, m, samples.q_next, samples.u) for m in maps}
    paid, found = samples.reward > 0, []
    assert int(paid.sum()) < 55
    for going in (paid, torch.ones_like(paid)):
        learner = OutputLearner(DEFINITION, Settings(), {}, {})
        found.append(_account_of(learner, samples.reward, inputs, going, 0.0, 1.0))
    assert found[1][1] == pytest.approx(found[0][1])
    assert len(found[1][0].posterior.y) == 60


@pytest.mark.parametrize(
    "pay",
    [
        lambda q, u: -q.square().sum(-1) - 0.1 * u[:, 0].square(),
        lambda q, _: (q[:, 0] > 0.2).double(),
        lambda q, _: q[:, 0].clamp_min(0),
        lambda q, _: -torch.ones(len(q), dtype=torch.float64),
        lambda q, _: torch.zeros(len(q), dtype=torch.float64),
        lambda q, u: bump(q, u) - 0.01 * u[:, 0].square(),
    ],
    ids=["squares", "step", "ramp", "constant", "nothing", "bump with a cost"],
)
def test_rewards_without_a_narrow_peak_are_not_learned_by_logarithm(pay):
    model = gaussian_processes(DEFINITION, drifting(pay, 24))
    assert model.reward.warp is None
    assert not model.reward_hides


def test_the_log_reward_ranks_points_whose_reward_is_practically_zero():
    model = gaussian_processes(DEFINITION, drifting(bump, 12))
    q = PLACE + torch.tensor([[0.0, 0.0], [0.5, 0.0], [1.6, 0.0]], dtype=torch.float64)
    near, far, farthest = model.promise(q, torch.zeros(3, 1, dtype=torch.float64)).tolist()
    assert near > far + 50 > farthest + 100


def test_a_model_of_the_log_reward_survives_storage():
    model = gaussian_processes(DEFINITION, drifting(bump, 12))
    loaded = from_bytes(DEFINITION, to_bytes(model))
    q, u = PLACE.expand(5, 2), torch.linspace(-1, 1, 5, dtype=torch.float64)[:, None]
    one, other = (m.transition(q, u, reward_std=True) for m in (model, loaded))
    assert torch.equal(one.reward, other.reward)
    assert torch.equal(one.reward_std, other.reward_std)


@pytest.mark.parametrize("change", [{"sign": 2.0}, {"size": -1.0}, {"base": float("inf")}])
def test_a_stored_log_reward_model_with_invalid_numbers_is_refused(change):
    stored = CODEC.encode(gaussian_processes(DEFINITION, drifting(bump, 12)))
    stored.header["outputs"][-1]["warp"] |= change
    with pytest.raises(InvalidInput, match="warp"):
        CODEC.decode(DEFINITION, stored)
