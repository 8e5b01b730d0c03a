"""Versions of the packages that a result depends on, the machine that it was made on, and the extra of surrogym that
installs a missing package."""

from __future__ import annotations

import os
import platform
import subprocess
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

PACKAGES = ("surrogym", "gymnasium", "numpy", "torch", "stable-baselines3")


def versions() -> dict[str, str]:
    """Return the versions of Python and of the installed packages in ``PACKAGES``, by name."""
    found = {"python": platform.python_version()}
    for name in PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found


def commit() -> str:
    """Return the git commit of this code, with ``-dirty`` if it has changes; outside of git the package's version."""
    here = Path(__file__)
    git = ["git", "-C", str(here.parent)]
    try:
        subprocess.run([*git, "ls-files", "--error-unmatch", here.name], check=True, capture_output=True)
        said = subprocess.run(
            [*git, "describe", "--always", "--dirty", "--abbrev=10", "--exclude=*"],
            check=True,
            capture_output=True,
            text=True,
        )
    except (OSError, subprocess.CalledProcessError):
        return version("surrogym")
    return said.stdout.strip()


def machine() -> str:
    """Describe the processor, the number of cores and the operating system in words."""
    return f"{_processor()}, {os.cpu_count()} cores, {platform.system()} {platform.machine()}"


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor() or "unknown processor"
    return next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), "processor")


EXTRAS = {  # modules that each extra of surrogym installs
    # The server needs numba, scipy, threadpoolctl and torch too, but if they are missing, it misses uvicorn first.
    "train": (
        *("cmaes", "matplotlib", "numba", "scipy", "stable_baselines3", "tensorboard", "threadpoolctl", "torch"),
    ),
    "server": (
        *("alembic", "fastapi", "jiter", "prometheus_client", "psycopg", "safetensors", "sqlalchemy"),
        *("starlette", "uvicorn"),
    ),
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
