"""``surrogym audit`` computes the promise in the session that the policy was compared in, with the noise known now."""

import pytest

from surrogym_client.cli.audit import _session
from surrogym_client.policies.card import PolicyCard
from surrogym_shared.wire import SurrogateView


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
def test_session_of_an_audit_has_the_noise_known_now(settings, noise, expected):
    assert _session(PolicyCard(settings=settings), view(noise)) == expected


def test_errors_of_a_sensor_are_observed():
    expected = {"process_noise": True, "sensor_noise": {"x": 0.07}}
    assert _session(PolicyCard(settings={"session": {}}), view(0.1, sensor=0.07)) == expected
