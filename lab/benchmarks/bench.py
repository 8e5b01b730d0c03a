"""All benchmarks but the longest, and a table of what was to be reached. Run by ``make bench``.

Each part is a script of its own, with sizes of its own; a part that fails is named and the others go on.
"""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path

from common import machine, parser

import report

PARTS = (
    "step",
    "cold",
    "peers",
    "train",
    "rollout",
    "search",
    "fit",
    "growth",
    "predict",
    "evidence",
    "calibration",
    "lists",
    "attacks",
    "start",
)
LONG = ("phases",)  # run where they are asked for


def main() -> None:
    made = parser(__doc__)
    made.add_argument("--parts", nargs="+", choices=PARTS + LONG, default=PARTS)
    options = made.parse_args()
    failed = [part for part in options.parts if not done(part, options.out, options.quick)]
    print("\n" + report.table(options.out))
    sys.exit(f"failed: {', '.join(failed)}" if failed else 0)


def done(part: str, out: Path, quick: bool) -> bool:
    print(f"\n== {part}: load {machine()['load']}", flush=True)
    start = time.monotonic()
    script = Path(__file__).with_name(f"bench_{part}.py")
    command = [sys.executable, str(script), "--out", str(out), *(["--quick"] if quick else [])]
    status = subprocess.run(command).returncode
    print(f"== {part}: {time.monotonic() - start:.0f} s" + (f", status {status}" if status else ""), flush=True)
    return status == 0


if __name__ == "__main__":
    main()
