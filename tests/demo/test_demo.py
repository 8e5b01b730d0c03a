"""The demo: three real processes end to end, and none of them left behind, however it ends."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
import uuid
from pathlib import Path

import pytest

from surrogym_trainer.policies import load_policy

pytestmark = [pytest.mark.e2e, pytest.mark.slow]

MARK = "DEMO_TEST_MARK"
SECONDS = 180.0
SMALL = ("--budget", "8")


class Demo:
    """A demo process, and everything that descends from it, known by a mark in its environment."""

    def __init__(self, folder: Path, *options: str) -> None:
        self.folder = folder
        self.mark = uuid.uuid4().hex
        self.process = subprocess.Popen(
            [sys.executable, "-m", "surrogym", "demo", "pendulum", "--out", str(folder), *options],
            env={**os.environ, MARK: self.mark},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )

    def family(self) -> list[int]:
        """Living processes with the mark."""
        return [int(p.name) for p in Path("/proc").iterdir() if p.name.isdigit() and self._marked(p)]

    def await_(self, condition, seconds: float = SECONDS) -> None:
        deadline = time.monotonic() + seconds
        while not condition():
            assert time.monotonic() < deadline, (self.folder, self.family())
            time.sleep(0.1)

    def await_training(self) -> None:
        self.await_(lambda: (self.folder / "training.jsonl").exists() or self.process.poll() is not None)
        assert self.process.poll() is None, self.process.communicate()

    def _marked(self, place: Path) -> bool:
        try:
            state = (place / "stat").read_text().rpartition(")")[2].split()[0]
            return state != "Z" and f"{MARK}={self.mark}".encode() in (place / "environ").read_bytes()
        except OSError:
            return False


@pytest.fixture
def demo(tmp_path):
    started = []

    def start(*options: str) -> Demo:
        started.append(Demo(tmp_path / "run", *options))
        return started[-1]

    yield start
    for one in started:
        for pid in one.family():
            os.kill(pid, signal.SIGKILL)
        one.process.communicate()


def test_a_small_demo_runs_to_the_end_and_writes_its_run_folder(demo, tmp_path):
    metrics_file = tmp_path / "metrics.json"
    small = demo(*SMALL, "--steps", "2048", "--episodes", "3", "--seed", "1", "--json", str(metrics_file))
    out, err = small.process.communicate(timeout=SECONDS)
    assert small.process.returncode == 0, err
    assert small.family() == []

    metrics = json.loads(metrics_file.read_text())
    assert (metrics["task"], metrics["seed"]) == ("pendulum", 1)
    queries = metrics["real_queries"]
    assert queries["initial"] + queries["adaptive"] == queries["total"] <= 8
    assert 0 < metrics["confidence_index"] <= 1
    assert metrics["fidelity"]["confidence_index"] == metrics["confidence_index"]
    assert 0 < metrics["virtual_steps"] <= 2_048
    assert set(metrics["seconds"]) == {"start", "design", "train", "evaluate", "report", "total"}
    assert metrics["seconds"]["total"] >= metrics["seconds"]["train"]
    assert metrics["real_return"]["episodes"] == len(metrics["returns"]) == 3
    assert metrics["evaluation_steps"] == 3 * 600  # Gymnasium's starts, starts anywhere, and without the policy
    assert metrics["without"]["actions"] == "zero"
    assert not metrics["reached"]
    assert (metrics["task"], metrics["budget"], metrics["seed"]) == ("pendulum", 8, 1)
    assert len(metrics["configuration"]) == len(metrics["specification"]) == 12
    assert 0 <= metrics["success_rate"] <= 1

    folder = small.folder
    assert json.loads((folder / "metrics.json").read_text()) == metrics
    names = ("policy.zip", "policy.json", "spec.json", "samples.csv", "samples.npz")
    pictures = ("samples.png", "learning.png", "returns.png", "rollout.png")
    assert all((folder / name).stat().st_size > 0 for name in (*names, *pictures))
    assert "a page to look at: http://127.0.0.1:" in err
    assert f"next: surrogym serve --database {folder / 'surrogym.db'}" in err
    for shown in (
        "task ",
        f" {queries['total']} + {queries['audit']} for the audit ",
        "confidence index",
        "virtual steps",
        "real return, 3 starts",
        "starts anywhere in the range",
        str(folder),
    ):
        assert shown in out
    assert "real return" not in err
    learned, after = out.split("target ")  # what was measured comes last, apart from what was learned from
    assert str(metrics["evaluation_steps"]) not in learned
    assert f"{metrics['evaluation_steps']} real steps, measured afterwards" in after


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupted_demo_ends_all_its_processes(demo, number):
    interrupted = demo(*SMALL)
    interrupted.await_training()
    assert len(interrupted.family()) >= 5  # the demo, the server, the sampler and its environment, the trainer
    interrupted.await_(lambda: (interrupted.folder / "training.jsonl").stat().st_size > 0)
    interrupted.process.send_signal(number)
    interrupted.process.wait(60)
    assert interrupted.process.returncode == 130
    said = interrupted.process.stderr.read()
    assert f"interrupted; all processes have ended; {interrupted.folder} keeps the real samples" in said
    assert f"and the policy so far ({interrupted.folder / 'policy.zip'})" in said
    assert load_policy(interrupted.folder / "policy.zip")
    assert interrupted.family() == []


def test_a_killed_demo_leaves_no_child_process_behind(demo):
    killed = demo(*SMALL)
    killed.await_training()
    killed.process.kill()
    killed.await_(lambda: killed.family() == [], seconds=60)


def test_a_dead_child_process_ends_the_demo_with_its_name(demo):
    failing = demo(*SMALL)
    failing.await_training()
    (trainer,) = [pid for pid in failing.family() if b"--progress-file" in Path(f"/proc/{pid}/cmdline").read_bytes()]
    os.kill(trainer, signal.SIGKILL)
    _, err = failing.process.communicate(timeout=60)
    assert failing.process.returncode == 1
    assert "error: the trainer ended with exit code -9" in err
    assert "Traceback" not in err
    assert failing.family() == []
