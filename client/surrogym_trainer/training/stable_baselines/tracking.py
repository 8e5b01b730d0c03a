"""Trackers of training curves: TensorBoard, Weights & Biases or MLflow."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import KVWriter

from surrogym_trainer.training.settings import TrainSettings

PROJECT = "surrogym"  # project or experiment of the runs in Weights & Biases and MLflow


@contextmanager
def tracking(settings: TrainSettings, out: Path) -> Iterator[list[BaseCallback]]:
    """Context manager that returns the callbacks of a training's tracker. The tracker's run ends with the context.

    TensorBoard needs no callback. Addresses and keys come from the trackers' own environment variables, such as
    ``WANDB_MODE`` and ``MLFLOW_TRACKING_URI``.

    Raises:
        ModuleNotFoundError: the tracker is not installed.
    """
    config = {name: str(value) for name, value in asdict(settings).items() if value not in (None, {})}
    if settings.tracker == "wandb":
        import wandb
        from wandb.integration.sb3 import WandbCallback

        out.parent.mkdir(parents=True, exist_ok=True)
        with wandb.init(project=PROJECT, name=out.stem, config=config, dir=out.parent, sync_tensorboard=True):
            yield [WandbCallback()]
    elif settings.tracker == "mlflow":
        import mlflow

        mlflow.set_experiment(PROJECT)
        with mlflow.start_run(run_name=out.stem):
            mlflow.log_params(config)
            yield [Mlflow()]
    else:
        yield []


class Mlflow(BaseCallback):
    """Callback that sends the algorithm's logged numbers to the active run of MLflow."""

    def _on_training_start(self) -> None:
        self.logger.output_formats.append(MlflowWriter())

    def _on_step(self) -> bool:
        return True


class MlflowWriter(KVWriter):
    """Output format of Stable-Baselines3's logger that logs numbers as metrics of MLflow."""

    def write(self, key_values: dict[str, Any], key_excluded: Mapping[str, Any], step: int = 0) -> None:
        import mlflow

        numbers = {
            name: float(value)
            for name, value in key_values.items()
            if isinstance(value, int | float) and "mlflow" not in (key_excluded[name] or ())
        }
        mlflow.log_metrics(numbers, step=step)

    def close(self) -> None:
        """Do nothing: the context manager of the run closes the run."""
