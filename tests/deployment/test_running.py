"""A deployed controller earns what its policy earns, also where it has to remember."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from support.compilers import NEEDS_C
from support.controllers import network
from support.rated import RatedRail
from surrogym_sampler.original.episodes import RolloutEpisode
from surrogym_sampler.original.rollouts import answering
from surrogym_shared.spec import DeclaredReward, Quantity, RewardTerm, Term
from surrogym_trainer.deployment.controller import Choices
from surrogym_trainer.deployment.reading import controller_of
from surrogym_trainer.deployment.running import Comparison
from surrogym_trainer.deployment.targets import TARGETS
from surrogym_trainer.policies import load_policy
from surrogym_trainer.policies.integrals import acting_with_integrals

EXAMPLES = Path(__file__).parents[2] / "examples"
pytestmark = NEEDS_C


def vessel():
    sys.path.insert(0, str(EXAMPLES))
    try:
        from dead_time import Vessel
    finally:
        sys.path.remove(str(EXAMPLES))
    return RolloutEpisode(answering(Vessel()))


@pytest.mark.parametrize("target", [name for name, one in TARGETS.items() if one.running])
def test_a_deployed_controller_with_lagged_inputs_earns_its_policys_returns(tmp_path: Path, target: str):
    episode = vessel()
    path = network(tmp_path, episode.spec, (32,), 0.5)
    controller, shares = controller_of(path, choices=Choices(period=1.0)), []
    with TARGETS[target].running(controller) as running:
        checked = Comparison(controller, running, load_policy(path), episode).over(range(5), shares.append)
    assert shares == [0.2, 0.4, 0.6, 0.8, 1.0]
    assert (checked.steps, checked.faults, checked.different) == (250, 0, 0)
    np.testing.assert_allclose(checked.returns, checked.policy_returns, rtol=1e-6)
    assert len(set(checked.returns)) == 5


@pytest.mark.parametrize("target", [name for name, one in TARGETS.items() if one.running])
def test_a_deployed_controller_that_sums_errors_earns_its_policys_returns(tmp_path: Path, target: str):
    episode = vessel()
    error = Quantity(term=Term.linear(level=1.0) + Term.constant(-0.3))
    reward = DeclaredReward(kind="declared", terms=(RewardTerm(shape="bump", of=(error,)),))
    spec = episode.spec.model_copy(update={"reward": reward})
    path = network(tmp_path, spec, (32,), 0.5, settings={"integral": ("level",)})
    controller = controller_of(path, choices=Choices(period=1.0))
    policy = acting_with_integrals(load_policy(path), spec, ("level",), {})
    with TARGETS[target].running(controller) as running:
        checked = Comparison(controller, running, policy, episode).over(range(3), [].append)
    assert (checked.steps, checked.faults, checked.different) == (150, 0, 0)
    np.testing.assert_allclose(checked.returns, checked.policy_returns, rtol=1e-6)


def test_a_deployed_controller_with_a_rate_decides_as_its_policy_under_the_rate(tmp_path: Path):
    episode = RolloutEpisode(answering(RatedRail()))
    path = network(tmp_path, episode.spec, (8,), 3.0)
    controller = controller_of(path)
    with TARGETS["c"].running(controller) as running:
        checked = Comparison(controller, running, load_policy(path), episode).over(range(3), [].append)
    assert (checked.faults, checked.different) == (0, 0)
    np.testing.assert_allclose(checked.returns, checked.policy_returns, rtol=1e-6)


def test_a_measurement_outside_its_range_counts_as_a_fault(tmp_path: Path):
    episode = vessel()
    path = network(tmp_path, episode.spec, (32,), 0.5)
    controller = controller_of(path, choices=Choices(ranges={"level": (-0.01, 0.01)}))
    with TARGETS["c"].running(controller) as running:
        checked = Comparison(controller, running, load_policy(path), episode).over(range(1), [].append)
    assert checked.faults > 0
