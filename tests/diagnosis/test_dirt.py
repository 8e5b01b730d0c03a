"""Each kind of dirt is found in 60 steps of a mass on a rail, and nothing is found in a clean one."""

from __future__ import annotations

import math

import numpy as np
import pytest

from surrogym_shared.dirt import Rollout, Sensors, identify
from surrogym_shared.dirt.dead_time import weights
from surrogym_shared.dirt.lattice import widths
from surrogym_shared.dirt.process import at
from surrogym_shared.dirt.stiction import sticking
from surrogym_shared.dirt.words import traits
from surrogym_shared.spec import BoxAction, Coordinate, EnvironmentSpec, ObservationEntry, Term, Uniform

PARTS = 20  # parts of a step
KNOWN = Sensors(("x", "v"), np.array([False, False]), np.array([True, True]), np.array([2.0, 2.0]), np.zeros(1))
SPEC = EnvironmentSpec(
    coordinates=tuple(Coordinate(name=name, sampling=Uniform(low=-1, high=1)) for name in KNOWN.names),
    observation=(ObservationEntry(name="x", term=Term.linear(x=1)),),
    action=BoxAction(low=(-1,), high=(1,)),
    start={name: Uniform(low=-0.1, high=0.1) for name in KNOWN.names},
    time_limit=20,
    sampling_period=0.1,
    query="rollout",
)


def rolled(delay: float = 0.0, noise: float = 0.0, friction: float = 0.0, width: float = 0.0, seed: int = 0):
    """Three rollouts of a mass whose speed decays, pushed by random actions that are held for one or two steps."""
    rng, rollouts = np.random.default_rng(seed), []
    for _ in range(3):
        x, v = rng.uniform(-0.1, 0.1, 2)
        actions = np.repeat(rng.choice([1.0, 0.3, 0.1], 10) * rng.uniform(-1, 1, 10), 2)
        pushes = np.concatenate([np.zeros(round(PARTS * delay)), np.repeat(actions, PARTS)])
        path = [(x, v)]
        for push in pushes[: 20 * PARTS].reshape(20, PARTS):
            for u in push:
                x += v / PARTS / 2
                v += (u - 0.2 * v) / PARTS
                v -= math.copysign(min(abs(v), friction / PARTS), v)
                x += v / PARTS / 2
            path.append((x, v))
        read = np.array(path) + noise * rng.standard_normal((21, 2))
        rollouts.append(Rollout(width * np.round(read / width) if width else read, actions[:, None]))
    return rollouts


def test_nothing_is_found_in_a_clean_machine():
    found = identify(rolled(), KNOWN)
    assert not found.named
    assert list(traits(found, KNOWN, SPEC, rolled())) == []


@pytest.mark.parametrize("delay", [0.5, 1.0, 2.3])
def test_a_dead_time_is_found_within_a_fifth_of_a_step(delay):
    found = identify(rolled(delay), KNOWN)
    assert found.delay is not None
    assert abs(found.delay.steps - delay) <= 0.2
    assert found.actions == math.ceil(delay)
    assert not found.noise
    ((name, said),) = traits(found, KNOWN, SPEC, rolled(delay))
    assert name == "dead time"
    assert said.startswith(f"actions take effect {found.delay.steps:.1f} steps late")
    assert said.endswith("certain")


def test_noise_of_the_sensors_is_found_with_its_standard_deviation():
    rollouts = rolled(noise=0.03)
    found = identify(rollouts, KNOWN)
    assert set(found.noise) == {"x", "v"}
    assert all(0.02 < noise.std < 0.045 for noise in found.noise.values())
    assert found.delay is None
    assert found.explained is not None
    assert found.explained.changes == 0
    strict = SPEC.model_copy(update={"tolerances": {"x": 0.001}})
    said = [said for name, said in traits(found, KNOWN, strict, rollouts) if name == "noise"]
    assert 'declare a tolerance of at least that, such as tolerances={"x": 0.0' in said[0]


def test_a_hidden_speed_is_found_and_is_no_dead_time():
    known = Sensors(("x",), KNOWN.turning[:1], KNOWN.moving[:1], KNOWN.span[:1], KNOWN.rest)
    found = identify([Rollout(rollout.read[:, :1], rollout.action) for rollout in rolled()], known)
    assert found.explained is not None
    assert (found.explained.changes, found.actions) == (1, 1)
    assert found.delay is None
    assert not found.noise


def test_the_width_of_an_encoder_is_found():
    assert widths(rolled(width=0.003), KNOWN) == {"x": pytest.approx(0.003), "v": pytest.approx(0.003)}
    assert widths(rolled(), KNOWN) == {}


def test_the_width_of_an_encoder_is_found_although_the_angle_wraps():
    width = 2 * math.pi / 1000
    known = Sensors(("x", "v"), np.array([True, False]), KNOWN.moving, KNOWN.span, KNOWN.rest)
    turned = [Rollout((width * np.round(7 * r.read / width) + np.pi) % (2 * np.pi) - np.pi, r.action) for r in rolled()]
    assert widths(turned, known)["x"] == pytest.approx(width, rel=1e-3)


def test_changes_that_are_multiples_of_an_actions_effect_are_no_encoder():
    rng = np.random.default_rng(0)
    rollouts = [Rollout(0.1 * rng.integers(-9, 9, (21, 2)) + rng.uniform(-1, 1, 2), np.ones((20, 1))) for _ in range(3)]
    assert widths(rollouts, KNOWN) == {}


def test_friction_that_sticks_is_found_with_the_largest_action_it_holds():
    stuck = sticking(rolled(friction=0.15), KNOWN, {}, 0)["x"]
    assert stuck.steps >= 3
    assert 0.0 < stuck.under[0] <= 0.15
    assert sticking(rolled(), KNOWN, {}, 0) == {}


def test_friction_that_sticks_is_told_from_slow_motion_under_an_encoder():
    rough, smooth = rolled(friction=0.3, width=0.003), rolled(width=0.003)
    assert "x" in sticking(rough, KNOWN, widths(rough, KNOWN), 0)
    assert sticking(smooth, KNOWN, widths(smooth, KNOWN), 0) == {}


def test_a_coordinate_that_rests_at_one_stop_does_not_stick():
    rollouts = [Rollout(np.minimum(r.read, 0.05), np.abs(r.action)) for r in rolled()]
    assert sticking(rollouts, KNOWN, {}, 0) == {}


@pytest.mark.parametrize(
    ("response", "delay", "expected"),
    [
        ("speed", 0.0, [1, 0, 0, 0]),
        ("speed", 1.25, [0, 0.75, 0.25, 0]),
        ("position", 0.5, [0.25, 0.75, 0, 0]),
        ("after change", 0.0, [0.5, 0.5, 0, 0]),
        ("after change", 0.5, [0.125, 0.75, 0.125, 0]),
    ],
)
def test_the_weights_of_past_actions_follow_from_the_dead_time(response, delay, expected):
    assert weights(response, delay, 4) == pytest.approx(expected)


def test_a_process_of_a_very_large_signal_has_a_finite_evidence():
    x = np.linspace(0, 1, 60)[:, None]
    assert math.isfinite(at(x, np.sin(x[:, 0]), np.array([2.0, 20.0, 0.0, -9.0])).evidence)


def test_rollouts_of_few_steps_tell_nothing_about_the_past():
    found = identify([Rollout(r.read[:4], r.action[:3]) for r in rolled()], KNOWN)
    assert found.explained is None
    assert found.delay is None
    assert found.actions == 0
