"""``surrogym audit`` computes the promise in the session that the policy was compared in, with the noise known now."""

import numpy as np
import pytest

from surrogym.cli.commands.audit import _require_fit
from surrogym.cli.errors import CommandError
from surrogym_sampler.original.classic import cartpole, pendulum
from surrogym_shared.network import Network
from surrogym_shared.wire import SurrogateView
from surrogym_trainer.policies.card import PolicyCard
from surrogym_trainer.training.cards import session_of


def view(noise: float, sensor: float = 0.0) -> SurrogateView:
    output = type("Output", (), {"name": "x", "noise": noise, "sensor_noise": sensor})()
    fidelity = type("Fidelity", (), {"outputs": [output]})()
    return SurrogateView.model_construct(fidelity=fidelity)


@pytest.mark.parametrize(
    ("settings", "noise", "expected"),
    [
        ({"session": {}, "judge": None}, 0.0, {}),
        ({"session": {}, "judge": None}, 0.1, {"process_noise": True}),
        ({"session": {"process_noise": False}}, 0.1, {"process_noise": False}),
        ({"session": {"particles": 1}, "judge": {"variant": "pathwise"}}, 0.0, {"variant": "pathwise"}),
    ],
    ids=["no noise", "confirmed after the training", "the user chose none", "compared along functions"],
)
def test_the_session_of_an_audit_uses_the_process_noise_currently_estimated(settings, noise, expected):
    assert session_of(PolicyCard(settings=settings), view(noise)) == expected


def test_the_session_of_an_audit_uses_the_estimated_sensor_noise():
    expected = {"process_noise": True, "sensor_noise": {"x": 0.07}}
    assert session_of(PolicyCard(settings={"session": {}}), view(0.1, sensor=0.07)) == expected


def test_auditing_a_policy_of_another_surrogate_is_refused_before_a_real_step():
    own, other = pendulum(), cartpole()
    policy = Network.of(own, np.zeros(3), np.ones(3), 2, np.zeros(Network.size(own, 2)))
    _require_fit(policy, own, "p.zip does not fit 'a'")
    with pytest.raises(CommandError, match=r"'b': expected .* 4 observation entries .* got one of 3"):
        _require_fit(policy, other, "p.zip does not fit 'b'")
    discrete = own.model_copy(update={"action": other.action})
    with pytest.raises(CommandError, match=r"discrete \(2\) actions, got one of 3 .* 1 continuous actions"):
        _require_fit(policy, discrete, "p.zip does not fit 'b'")
