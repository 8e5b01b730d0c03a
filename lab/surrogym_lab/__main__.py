"""``python -m surrogym_lab``."""

from __future__ import annotations

from surrogym.cli import run
from surrogym_lab.commands import build

if __name__ == "__main__":
    run(build, "python -m surrogym_lab")
