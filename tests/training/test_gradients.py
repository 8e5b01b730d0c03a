"""Gradients through the model as a policy search: the same policy as of `surrogym optimise`, over the port."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from support.installed import metadata_into
from support.server import ServerProcess
from surrogym_client.environments import open_file
from surrogym_client.surrogates.transfer import export_surrogate
from surrogym_client.transport import Api, HttpSurrogate
from surrogym_sampler.original.classic import cartpole
from surrogym_server.gradients import GradientSettings, optimise
from surrogym_shared.network import Network
from surrogym_trainer.policies import load_policy
from surrogym_trainer.training import TrainSettings, train
from surrogym_trainer.training.closed_loop import ClosedLoop, LoopSettings

LANES, HORIZON, LIMIT, UPDATES = 8, 10, 200, 6
STEPS = UPDATES * LANES * HORIZON + 12 * 64 * LIMIT


@pytest.fixture(autouse=True)
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(metadata_into(tmp_path / "site")))


def few(**settings: object) -> TrainSettings:
    return TrainSettings(
        **{
            "algorithm": "gradient",
            "total_steps": STEPS,
            "hyperparameters": {"lanes": LANES, "horizon": HORIZON, "units": 4},
            **settings,
        }
    )


def test_it_finds_the_policy_of_optimise_with_the_servers_model(pendulum_server: ServerProcess, tmp_path: Path):
    seen = []
    with HttpSurrogate(pendulum_server.url, "pendulum") as port, Api(pendulum_server.url) as api:
        result = train(port, tmp_path / "policy.zip", few(), seen.append)
        (tmp_path / "model.surrogate").write_bytes(export_surrogate(api, "pendulum").to_bytes())
    surrogate = open_file(tmp_path / "model.surrogate")
    settings = GradientSettings(updates=UPDATES, lanes=LANES, horizon=HORIZON, units=4)
    expected = optimise(surrogate, settings)
    np.testing.assert_array_equal(Network.load(result.path).vector, expected.policy.vector)
    assert (result.imagined_return, result.virtual_steps) == (expected.imagined_return, expected.virtual_steps)
    assert result.algorithm == "GRADIENT"
    assert result.virtual_steps <= result.settings["total_steps"] == STEPS
    steps = [now.steps for now in seen]
    assert (len(steps), steps[-1]) == (UPDATES, STEPS)
    assert steps == sorted(steps)
    assert np.abs(load_policy(result.path)(np.zeros((5, 3), np.float32))).max() <= 2


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        (
            {"start_from": Path("policy.zip")},
            "GRADIENT always begins with a new network: expected no policy to start from",
        ),
        ({"session": {"penalty": 1.0}}, r"expected no session options, got \['penalty'\]"),
        (
            {"hyperparameters": {"speed": 1}},
            "GRADIENT takes lanes, horizon, units, learning_rate, largest_norm",
        ),
        ({"prolong": True}, "GRADIENT trains for a fixed number of steps"),
    ],
)
def test_options_without_meaning_for_gradients_are_refused(
    pendulum_server: ServerProcess, tmp_path: Path, settings: dict[str, object], said: str
):
    with (
        HttpSurrogate(pendulum_server.url, "pendulum") as port,
        pytest.raises(ValueError, match=said),
    ):
        train(port, tmp_path / "policy.zip", few(**settings))
    assert not list(tmp_path.glob("policy*"))


def test_a_surrogate_without_a_model_at_hand_is_refused(tmp_path: Path):
    class Port:
        def spec(self):
            return cartpole()

    with pytest.raises(ValueError, match="gradients need the model: expected a surrogate of a server or a file"):
        train(Port(), tmp_path / "policy.zip", few())


def test_rounds_are_refused_before_a_real_step(pendulum_server: ServerProcess, tmp_path: Path):
    with (
        HttpSurrogate(pendulum_server.url, "pendulum") as port,
        Api(pendulum_server.url) as api,
        pytest.raises(ValueError, match="gradient can't start from a policy: expected no rounds"),
    ):
        ClosedLoop(api, "pendulum", port, tmp_path / "policy.zip", few(), LoopSettings(queries=1)).train()
