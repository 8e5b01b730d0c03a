"""Trainers of others against a live server: those of the base install here, the rest where their packages are."""

from __future__ import annotations

from pathlib import Path

from support.examples import EXAMPLES, EXTRAS, needs_extras, run
from support.server import ServerProcess


def program(name: str) -> str:
    return str(EXAMPLES / name)


def test_the_stable_baselines3_example_trains_on_a_surrogate(server: ServerProcess, tmp_path: Path) -> None:
    said = run(server, tmp_path, program("train_sb3.py"), "pendulum", "--steps", "2048")
    assert "imagined return: -" in said
    assert (tmp_path / "sb3.zip").exists()
    assert list((tmp_path / "runs" / "sb3").rglob("events.out.tfevents.*"))


def test_the_plain_loop_example_trains_on_a_surrogate(server: ServerProcess, tmp_path: Path) -> None:
    said = run(server, tmp_path, program("train_cleanrl.py"), "pendulum", "--steps", str(7 * 2048))
    assert said.startswith("14336 steps, imagined return -")
    assert (tmp_path / "cleanrl.pt").exists()


@needs_extras
def test_the_torchrl_example_trains_on_a_surrogate(server: ServerProcess, tmp_path: Path) -> None:
    said = run(server, tmp_path, program("train_torchrl.py"), "pendulum", "--steps", str(7 * 1024), python=str(EXTRAS))
    assert "imagined return -" in said
    assert (tmp_path / "torchrl.pt").exists()


@needs_extras
def test_the_tianshou_example_trains_on_a_surrogate(server: ServerProcess, tmp_path: Path) -> None:
    said = run(server, tmp_path, program("train_tianshou.py"), "pendulum", "--steps", "2048", python=str(EXTRAS))
    assert "imagined return: -" in said
    assert (tmp_path / "tianshou.pt").exists()


@needs_extras
def test_the_rllib_example_trains_on_a_surrogate(server: ServerProcess, tmp_path: Path) -> None:
    said = run(server, tmp_path, program("train_rllib.py"), "pendulum", "--iterations", "2", python=str(EXTRAS))
    assert "iteration 2: imagined return -" in said
