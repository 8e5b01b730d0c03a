"""Weights & Biases and MLflow themselves, where they are installed: no account, no network, files on this machine."""

from __future__ import annotations

from pathlib import Path

from support.examples import EXTRAS, needs_extras, run
from support.server import ServerProcess

TRAIN = ("-m", "surrogym", "train", "pendulum", "--steps", "1024", "--num-envs", "8", "--quiet")


@needs_extras
def test_a_training_logs_its_curves_to_weights_and_biases(server: ServerProcess, tmp_path: Path) -> None:
    run(server, tmp_path, *TRAIN, "--log", "wandb", python=str(EXTRAS), WANDB_MODE="offline")
    (log,) = (tmp_path / "wandb").glob("offline-run-*/run-*.wandb")
    assert b"surrogym/imagined_return" in log.read_bytes()


@needs_extras
def test_a_training_logs_its_curves_to_mlflow(server: ServerProcess, tmp_path: Path) -> None:
    store = f"sqlite:///{tmp_path}/mlflow.db"
    run(server, tmp_path, *TRAIN, "--log", "mlflow", python=str(EXTRAS), MLFLOW_TRACKING_URI=store)
    ask = (
        "import mlflow; run, = mlflow.search_runs(experiment_names=['surrogym'], output_format='list'); "
        "print(run.info.run_name, run.data.metrics['surrogym/imagined_return'], run.data.params['seed'])"
    )
    said = run(server, tmp_path, "-c", ask, python=str(EXTRAS), MLFLOW_TRACKING_URI=store).split()
    assert (said[0], float(said[1]) < 0, said[2]) == ("policy", True, "0")
