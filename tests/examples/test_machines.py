"""The machines of examples/machines keep the protocol and the laws of mechanics, and their dirt is as declared."""

from __future__ import annotations

import dataclasses
import importlib
import math
import shlex
import sys
from typing import Any

import numpy as np
import pytest

from support.examples import EXAMPLES
from surrogym_sampler.diagnosis.executables import conformance

FOLDER = EXAMPLES / "machines"
KINDS = {"furuta": "Furuta", "double_pendulum": "DoublePendulum", "belt": "Belt"}


@pytest.fixture(autouse=True)
def importable(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(FOLDER))


def made(name: str, seed: int = 0, *, clean: bool = False) -> Any:
    return getattr(importlib.import_module(name), KINDS[name])(seed, clean)


def path(machine: Any, actions: list[float], seed: int = 3) -> np.ndarray:
    """What the sensors read in one episode (T + 1, 2)."""
    return np.array([machine.reset(seed), *(machine.step(action) for action in actions)])


def commanded(name: str, *options: str) -> str:
    return shlex.join([sys.executable, str(FOLDER / f"{name}.py"), *options])


@pytest.mark.parametrize("name", KINDS)
def test_every_dirty_machine_passes_the_protocol_checks(name: str) -> None:
    checked = list(conformance(commanded(name, "--seed", "7"), 30.0))
    assert {outcome.name: outcome.failure for outcome in checked if outcome.failure} == {}
    assert len(checked) > 10


@pytest.mark.parametrize("name", KINDS)
@pytest.mark.parametrize("clean", [False, True])
def test_a_machine_without_friction_and_input_keeps_its_energy(name: str, clean: bool) -> None:
    machine = made(name, clean=clean)
    machine.reset(0)
    machine.dirt = dataclasses.replace(machine.dirt, sliding=())
    machine.damping = np.zeros(len(machine.q))
    machine.loss = 0.0
    machine.q[1] += 2.0
    before = machine.energy(machine.q, machine.v)
    moved = 0.0
    for _ in range(100):
        machine.step(0.0)
        moved = max(moved, 0.5 * machine.v @ machine.mass(machine.q) @ machine.v)
    assert abs(machine.energy(machine.q, machine.v) - before) < 1e-3 * moved


@pytest.mark.parametrize("name", KINDS)
def test_a_seed_fixes_a_machine_and_its_episodes(name: str) -> None:
    actions = np.random.default_rng(0).uniform(-4, 4, 30).tolist()
    assert np.array_equal(path(made(name, 5), actions), path(made(name, 5), actions))
    assert not np.array_equal(path(made(name, 5), actions), path(made(name, 6), actions))
    assert not np.array_equal(path(made(name, 5), actions), path(made(name, 5, clean=True), actions))


@pytest.mark.parametrize("name", KINDS)
def test_friction_at_rest_holds_a_machine_against_small_actions(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    machine = made(name)
    hanging = 0.0 if name == "double_pendulum" else math.pi
    monkeypatch.setattr(machine, "start", lambda _: [0.0, hanging, 0.0][: len(machine.dirt.sliding)])
    machine.dirt = dataclasses.replace(machine.dirt, noise=())
    held = machine.dirt.sliding[-1 if name == "belt" else 0] / (machine.pull if name == "furuta" else 1.0)
    assert np.ptp(path(machine, [0.5 * held] * 20), axis=0).max() < 1e-3
    assert np.ptp(path(machine, [6.0] * 20), axis=0).max() > 0.05


def test_an_action_of_the_furuta_pendulum_takes_effect_after_10_milliseconds() -> None:
    late = made("furuta")
    late.dirt = dataclasses.replace(made("furuta", clean=True).dirt, delay=late.dirt.delay)
    soon = made("furuta", clean=True)
    soon.period, soon.seconds = 0.01, 5.0
    assert np.allclose(path(late, [3.0, 0.0])[-1], path(soon, [0.0, 3.0, 3.0, 0.0])[-1], atol=1e-6)


def test_the_furuta_pendulum_has_encoders_of_2048_counts() -> None:
    read = path(made("furuta"), [2.0, -2.0] * 10) * 2048 / (2 * math.pi)
    assert np.allclose(read, np.round(read), atol=1e-6)


def test_the_motor_of_the_belt_moves_before_the_cart_does(monkeypatch: pytest.MonkeyPatch) -> None:
    machine = made("belt")
    monkeypatch.setattr(machine, "start", lambda _: [0.0, math.pi, 0.0])
    machine.reset(0)
    cart = machine.q[0]
    for _ in range(5):
        machine.move(2.0, 0.001)
    assert machine.q[0] == cart
    assert machine.q[2] > cart
