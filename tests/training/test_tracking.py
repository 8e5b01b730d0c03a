"""Where the curves of a training go, as far as the base install has it; tests/examples has the trackers themselves."""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from support.models import learn
from support.real_steps import random_steps
from surrogym_sampler.original.classic import pendulum
from surrogym_server.convert import definition_from_spec
from surrogym_server.local import LocalSurrogate
from surrogym_trainer.training import TrainSettings, train

HYPERPARAMETERS = {"n_steps": 16, "batch_size": 32, "n_epochs": 1}


@pytest.fixture(scope="module")
def surrogate() -> LocalSurrogate:
    spec = pendulum()
    return LocalSurrogate(spec, learn(definition_from_spec(spec), random_steps(spec, 8, seed=0)).model)


def small(**settings: Any) -> TrainSettings:
    return TrainSettings(total_steps=256, num_envs=8, hyperparameters=HYPERPARAMETERS, **settings)


def test_training_curves_are_written_for_tensorboard_beside_the_policy(
    surrogate: LocalSurrogate, tmp_path: Path
) -> None:
    train(surrogate, tmp_path / "policy.zip", small(tracker="tensorboard"))
    (run,) = (tmp_path / "tensorboard").iterdir()
    curves = EventAccumulator(str(run)).Reload().Tags()["scalars"]
    assert {"surrogym/imagined_return", "surrogym/penalty_share", "train/loss"} <= set(curves)


def test_without_a_tracker_training_writes_only_policy_and_settings(
    surrogate: LocalSurrogate, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    train(surrogate, tmp_path / "policy.zip", small())
    assert {path.name for path in tmp_path.iterdir()} == {"policy.zip", "policy.json"}


def test_a_training_logs_settings_and_metrics_to_mlflow(
    surrogate: LocalSurrogate, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    told = Recorder()
    monkeypatch.setitem(sys.modules, "mlflow", told)
    train(surrogate, tmp_path / "policy.zip", small(tracker="mlflow", seed=3))
    assert told.runs == ["policy"]
    assert told.params["seed"] == "3"
    assert told.steps == sorted(told.steps)
    assert "surrogym/imagined_return" in told.metrics
    assert all(isinstance(value, float) for value in told.metrics.values())


def test_a_training_with_a_missing_tracker_is_refused_before_it_starts(
    surrogate: LocalSurrogate, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "wandb", None)
    with pytest.raises(ModuleNotFoundError, match="wandb"):
        train(surrogate, tmp_path / "policy.zip", small(tracker="wandb"))
    assert not (tmp_path / "policy.zip").exists()


def test_training_with_cma_es_refuses_a_tracker(surrogate: LocalSurrogate, tmp_path: Path) -> None:
    settings = TrainSettings(algorithm="cmaes", tracker="mlflow")
    with pytest.raises(ValueError, match="leave mlflow out"):
        train(surrogate, tmp_path / "policy.zip", settings)


class Recorder(ModuleType):
    """What the client calls of MLflow."""

    def __init__(self) -> None:
        super().__init__("mlflow")
        self.runs: list[str] = []
        self.params: dict[str, str] = {}
        self.metrics: dict[str, float] = {}
        self.steps: list[int] = []

    def set_experiment(self, name: str) -> None:
        assert name == "surrogym"

    @contextmanager
    def start_run(self, run_name: str) -> Iterator[None]:
        self.runs.append(run_name)
        yield

    def log_params(self, params: dict[str, str]) -> None:
        self.params = params

    def log_metrics(self, metrics: dict[str, float], step: int) -> None:
        self.metrics |= metrics
        self.steps.append(step)
