"""Columns that wrap and columns that only fall back, drawn with known truth: never confused without a word."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest

from surrogym_shared.logs.checking import ReadLog, draft_log
from surrogym_shared.logs.columns import mapping_of, roles_by_mapping, roles_by_name
from surrogym_shared.logs.table import Floats, Table

DRAWS = range(20)
SIZES = (2 * math.pi, 360, 400, 24, 1, 60, 4096, 1024, 6400, 12)
Rule = Callable[[float, float], float]


def drafted(columns: dict[str, Floats], **mapping) -> ReadLog:
    table = Table(columns, np.arange(2, 2 + len(columns["x"])))
    roles = roles_by_name(table.names)
    if mapping:
        roles = roles_by_mapping(mapping_of(roles.mapping.model_dump() | mapping, "the mapping"), table.names)
    return draft_log(table, roles, "drawn")


def recorded(rng: np.random.Generator, rows: int, start: float, after: Rule, digits: int = 5) -> dict[str, Floats]:
    """A log of a state that moves by a rule of itself and the action."""
    u, x = rng.uniform(-1, 1, rows), np.empty(rows)
    x[0] = start
    for k in range(rows - 1):
        x[k + 1] = after(x[k], u[k])
    return {"x": x.round(digits), "action_u": u, "reward": -x}


def turning(rng: np.random.Generator, size: float, digits: int = 5) -> dict[str, Floats]:
    pace, noise, low = rng.uniform(0.02, 0.08), rng.choice([0, 0.02]), rng.choice([0, -0.5])
    grain = 0.0 if digits else 1.0

    def after(x: float, u: float) -> float:
        moved = (x + size * pace * (1 + 0.5 * u + noise * rng.normal()) - low * size) % size + low * size
        return min(moved, size + low * size - grain)

    return recorded(rng, int(rng.integers(150, 400)), (low + 0.9) * size, after, digits)


def test_a_log_column_that_wraps_around_is_reported_with_its_period():
    for seed in DRAWS:
        rng = np.random.default_rng(seed)
        size = SIZES[seed % len(SIZES)]
        log = drafted(turning(rng, size))
        if size == SIZES[0]:
            assert log.spec.coordinates[0].kind == "angle"
        else:
            assert log.spec.coordinates[0].kind == "linear"
            assert any(note.startswith(f"x: jumps by {size:g}") for note in log.notes), (seed, size, log.notes)


def test_an_integer_encoder_column_that_wraps_is_reported():
    for seed in DRAWS:
        rng = np.random.default_rng(seed)
        size = (4096, 1024, 360, 400)[seed % 4]
        log = drafted(turning(rng, size, digits=0))
        assert any(note.startswith(f"x: jumps by {size}") for note in log.notes), (seed, log.notes)


def falling(rng: np.random.Generator) -> dict[str, Floats]:
    """A level, pressure or pH that rises and falls back at once, within what could be a turn."""
    size = float(rng.choice([2 * math.pi, 1, 24, 60]))
    bottom, top = rng.uniform(0.01, 0.06) * size, rng.uniform(0.93, 0.97) * size
    rise, steered = rng.uniform(0.01, 0.03) * size, rng.uniform(0.2, 0.9)
    spread = rng.choice([0, 0.01]) * size
    sign = rng.choice([-1, 1])

    def after(x: float, u: float) -> float:
        y = x if sign > 0 else size - x
        y = bottom + spread * rng.random() if y > top else y + rise * (1 + steered * u)
        return y if sign > 0 else size - y

    return recorded(rng, int(rng.integers(200, 500)), size / 2, after, 4)


def test_a_state_that_periodically_falls_back_is_not_drafted_as_angle():
    """Levels, pressures and pH of 0 to 6 became angles."""
    for seed in DRAWS:
        log = drafted(falling(np.random.default_rng(seed)))
        assert log.spec.coordinates[0].kind == "linear", seed
        assert not any("jumps" in note for note in log.notes), (seed, log.notes)


def siphon(rng: np.random.Generator) -> Rule:
    return lambda x, _: 0.1 * rng.random() if x > 6 else x + 0.3 * rng.random()


def gearbox(rng: np.random.Generator) -> Rule:
    def shifted(x: float, u: float) -> float:
        if rng.random() < 0.05:
            return 0.0 if x > 3 else 6.0
        return float(min(max(x + round(1.4 * u), 0), 6))

    return shifted


@pytest.mark.parametrize("plant", [siphon, gearbox])
def test_irregularly_falling_and_integer_states_are_not_drafted_as_angles(plant: Callable[[np.random.Generator], Rule]):
    for seed in DRAWS:
        rng = np.random.default_rng(seed)
        assert drafted(recorded(rng, 400, 3.0, plant(rng))).spec.coordinates[0].kind == "linear"


@pytest.mark.parametrize("seed", [0, 10])
def test_angles_declared_in_the_mapping_override_the_detection(seed: int):
    """An empty list of angles did not switch off what the data seemed to show."""
    turned = turning(np.random.default_rng(seed), 2 * math.pi)
    fallen = falling(np.random.default_rng(seed))
    assert drafted(turned, angles=[]).spec.coordinates[0].kind == "linear"
    assert drafted(turned, angles=None).spec.coordinates[0].kind == "angle"
    assert drafted(fallen, angles=["x"]).spec.coordinates[0].kind == "angle"


def test_a_pendulum_angle_is_recognised_from_its_speed_and_one_jump():
    """Its change depends on the speed beside it, and one jump among its steps is enough."""
    for seed in DRAWS:
        rng = np.random.default_rng(seed)
        rows = 300
        theta, speed, u = np.zeros(rows), np.zeros(rows), rng.uniform(-2, 2, rows)
        theta[0], speed[0] = rng.uniform(-3, 3), rng.uniform(3, 6)
        for k in range(rows - 1):
            speed[k + 1] = speed[k] + 0.05 * (10 * math.sin(theta[k]) + 3 * u[k])
            theta[k + 1] = theta[k] + 0.05 * speed[k + 1]
        wrapped = (theta + math.pi) % (2 * math.pi) - math.pi
        columns = {"x": wrapped, "speed": speed, "action_u": u, "reward": -(wrapped**2)}
        jumps = int((np.abs(np.diff(wrapped)) > math.pi).sum())
        assert (drafted(columns).spec.coordinates[0].kind == "angle") == (jumps > 0), seed
