"""Advice for missing packages: the extra of surrogym that installs them."""

from __future__ import annotations

EXTRAS = {  # modules that each extra of surrogym installs
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
    """Return the advice to install the extra that contains a missing module; None if no extra contains it."""
    for extra, modules in EXTRAS.items():
        if module in modules:
            return f"this needs {module}, which is not installed: pip install 'surrogym[{extra}]'"
    return None
