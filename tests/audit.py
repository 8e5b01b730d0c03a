"""Known holes of the pinned packages, by pip-audit. Where they can't be looked up, that is said, and nothing fails."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

PINS = Path(__file__).parents[1] / "constraints.txt"
SECONDS = 120
COMMAND = [sys.executable, "-m", "pip_audit", "--requirement", str(PINS), "--no-deps", "--disable-pip"]
OPTIONS = ["--format", "json", "--progress-spinner", "off", "--timeout", "5"]


def verdict(output: str) -> tuple[int, str]:
    """Exit status and a message, from what pip-audit wrote; 1 for a known hole alone."""
    try:
        packages: list[dict[str, Any]] = json.loads(output)["dependencies"]
    except (ValueError, LookupError):
        return 0, "audit SKIPPED: pip-audit is not installed, or its database can't be reached"
    asked = [package for package in packages if "skip_reason" not in package]
    if not asked:
        return 0, f"audit SKIPPED: none of the {len(packages)} packages could be looked up from here"
    holes = [f"{p['name']} {p['version']}: {hole['id']}" for p in asked for hole in p["vulns"]]
    told = f"audit: {len(asked)} of {len(packages)} packages looked up, {len(holes)} known holes"
    return int(bool(holes)), "\n".join([told, *holes])


def main() -> int:
    try:
        output = subprocess.run([*COMMAND, *OPTIONS], capture_output=True, text=True, timeout=SECONDS).stdout
    except subprocess.TimeoutExpired:
        output = ""
    status, message = verdict(output)
    print(message)
    return status


if __name__ == "__main__":
    sys.exit(main())
