"""Advice for a person about missing packages."""

from __future__ import annotations

EXTRAS = {  # their packages
    "server": (
        *("alembic", "fastapi", "jiter", "numba", "prometheus_client", "psycopg", "safetensors", "scipy", "sqlalchemy"),
        *("starlette", "threadpoolctl", "uvicorn"),
    ),
    "train": ("cmaes", "matplotlib", "stable_baselines3", "tensorboard", "torch"),
    "export": ("onnx", "onnxruntime", "onnxscript"),
    "render": ("imageio_ffmpeg", "moviepy", "PIL", "pygame"),
    "trackers": ("mlflow", "wandb"),
    "mujoco": ("mujoco", "imageio"),
    "dm-control": ("dm_control",),
    "robotics": ("gymnasium_robotics",),
    "pcgym": ("pcgym",),
    "fmu": ("fmpy",),
}


def missing(module: str) -> str | None:
    """Say which extra brings a module; None for a module of no extra."""
    for extra, modules in EXTRAS.items():
        if module in modules:
            return f"this needs {module}, which is not installed: pip install 'surrogym[{extra}]'"
    return None
