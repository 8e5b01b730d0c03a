"""A program that passes requests on to another one, and crashes or hangs at random steps.

Started as ``python crashing.py DIARY SEED PROBABILITY HANGS COMMAND...``. The diary gets a line before each crash, so
that a crash takes none back; its length continues the random numbers after a restart.
"""

from __future__ import annotations

import json
import os
import random
import resource
import subprocess
import sys
import time
from pathlib import Path

CRASHES = ("abort", "half an answer", "hang")  # within a step
BETWEEN = "exit"  # after the answer to a step


def crash(kind: str, answer: bytes) -> None:
    """Fail as ``kind`` says; ``answer`` is what the step gave."""
    os.write(2, f"fault: {kind}\n".encode())
    if kind == "abort":
        os.abort()
    if kind == "hang":
        time.sleep(3600)
    os.write(1, answer if kind == BETWEEN else answer[: len(answer) // 2])
    os._exit(0 if kind == BETWEEN else 1)


def main(path: Path, seed: str, probability: float, hangs: int, command: list[str]) -> None:
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    diary = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT)
    before = path.read_text().split("\n")[:-1]
    source, left = random.Random(f"{seed} {len(before)}"), hangs - before.count("hang")
    plant = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    for line in sys.stdin.buffer:
        plant.stdin.write(line)
        plant.stdin.flush()
        answer = plant.stdout.readline()
        method = json.loads(line)["method"]
        if method == "set":
            os.write(diary, b"set\n")
        if method == "step":
            kinds = [*CRASHES[:2], BETWEEN] if left <= 0 else [*CRASHES, BETWEEN]
            kind = source.choice(kinds) if source.random() < probability else "answered"
            os.write(diary, f"{kind}\n".encode())
            if kind != "answered":
                crash(kind, answer)
        os.write(1, answer)


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2], float(sys.argv[3]), int(sys.argv[4]), sys.argv[5:])
