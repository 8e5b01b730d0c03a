"""Checks of a program's states: resets, states that are set, and snapshots.

Shapes: C coordinates.
"""

from __future__ import annotations

import json

import numpy as np

from surrogym_sampler.diagnosis.access import CLOSE, EXACT, apart
from surrogym_sampler.diagnosis.executables.subject import LeftOut, Subject
from surrogym_sampler.diagnosis.outcomes import Mismatch, expect
from surrogym_sampler.original.executables.messages import action_entries, text, truth
from surrogym_sampler.original.protocol import Array
from surrogym_shared.spec import Fixed, limits

PLACES = 3  # number of random states in a check
SEEDS = 5
WANDERING = 5  # before a check repeats a step, it takes this many random steps, which must not change the result
# A test sets coordinates to this share of their ranges. Python writes so small a number with an exponent, which the
# program must be able to read.
TINY = 1e-6


def a_reset_without_a_seed_gives_a_state(subject: Subject) -> None:
    subject.reset(None)


def a_seed_repeats_its_start(subject: Subject) -> None:
    start = subject.reset(1)
    subject.step(subject.random_action())
    subject.reset(2)
    _expect_near(subject, "start with seed 1", start, subject.reset(1), EXACT)


def other_seeds_give_other_starts(subject: Subject) -> None:
    spec = subject.spec
    if len(spec.starts) == 1 or (not spec.starts and all(isinstance(start, Fixed) for start in spec.start.values())):
        raise LeftOut("the program's specification declares a single start state, so all seeds give the same start")
    starts = {tuple(subject.reset(seed).tolist()) for seed in range(SEEDS)}
    if len(starts) == 1:
        raise Mismatch(
            f"expected different start states after resets with {SEEDS} different seeds, got {list(*starts)} each time"
        )


def set_reaches_the_state(subject: Subject) -> None:
    for state in (*(subject.random_state() for _ in range(PLACES)), _tiny(subject)):
        _expect_near(subject, "state after set", state, subject.set(state), CLOSE)


def get_gives_the_state_that_was_set(subject: Subject) -> None:
    for _ in range(PLACES):
        reached = subject.set(subject.random_state())
        got = subject.state(subject.ask_if_supported("get"))
        _expect_near(subject, "state of get", reached, got, EXACT)


def a_step_depends_on_nothing_but_state_and_action(subject: Subject) -> None:
    """Take the same step from the same state three times in a row, then once more after other steps. If the last result
    differs, the program remembers more than its state. If already the second and the third result differ, the plant is
    noisy and the check does not apply."""
    for _ in range(PLACES):
        state, action = subject.random_state(), subject.random_action()
        _, first, again = (_step_from(subject, state, action) for _ in range(3))
        if _difference(subject, first, again) > EXACT:
            raise LeftOut(
                f"the same step from {state.tolist()}, taken twice, gave two results, so the environment is noisy"
            )
        _wander(subject)
        _expect_same(subject, "step after other steps", first, _step_from(subject, state, action))


def restore_returns_to_what_was_saved(subject: Subject) -> None:
    subject.reset(0)
    action = subject.random_action()
    snapshot = text(subject.ask_if_supported("save"), "snapshot")
    first = subject.step(action)
    _wander(subject)
    subject.state(subject.ask("restore", snapshot=snapshot))
    _expect_same(subject, "step after restore", first, subject.step(action))


def a_program_that_was_started_anew_is_the_same(subject: Subject) -> None:
    spec, start = subject.spec, subject.reset(1)
    subject.start()
    expect("specification", json.loads(spec.model_dump_json()), json.loads(subject.spec.model_dump_json()))
    _expect_near(subject, "start with seed 1", start, subject.reset(1), EXACT)


def _tiny(subject: Subject) -> Array:
    """Return a random state (C,) that is almost 0 in each coordinate whose range includes 0."""
    ranges = [limits(coordinate.sampling) for coordinate in subject.spec.coordinates]
    drawn = subject.random_state()
    return np.array(
        [TINY * (high - low) if low < 0 < high else q for (low, high), q in zip(ranges, drawn, strict=True)]
    )


def _step_from(subject: Subject, state: Array, action: Array) -> Array:
    subject.set(state)
    return subject.step(action)


def _wander(subject: Subject) -> None:
    """Reset, and take ``WANDERING`` random steps or fewer if the episode ends."""
    subject.reset(0)
    for _ in range(WANDERING):
        reply = subject.ask("step", action=action_entries(subject.spec.action, subject.random_action()))
        if truth(reply, "terminated") or truth(reply, "truncated"):
            return


def _difference(subject: Subject, one: Array, other: Array) -> float:
    """Return the largest difference between two results of a step, (C + 1,) each: a next state, followed by the reward.
    Differences of coordinates are shares of the sampling range; the difference of the rewards is relative."""
    paid = abs(one[-1] - other[-1]) / max(1.0, abs(one[-1]))
    return max(apart(subject.spec, one[:-1], other[:-1]), float(paid))


def _expect_same(subject: Subject, what: str, expected: Array, came: Array) -> None:
    if _difference(subject, expected, came) > EXACT:
        raise Mismatch(f"{what}: expected state and reward {expected.tolist()}, got {came.tolist()}")


def _expect_near(subject: Subject, what: str, expected: Array, came: Array, allowed: float) -> None:
    if apart(subject.spec, expected, came) > allowed:
        raise Mismatch(f"{what}: expected {expected.tolist()}, got {came.tolist()}")


CHECKS = (
    (a_reset_without_a_seed_gives_a_state, "accept null for 'seed', and choose any start"),
    (a_seed_repeats_its_start, "seed every random number from 'seed' at each reset"),
    (other_seeds_give_other_starts, "use 'seed', or declare one start in the specification"),
    (set_reaches_the_state, 'read numbers with fraction and exponent, or declare "query": "rollout"'),
    (get_gives_the_state_that_was_set, "answer get with the same numbers as set"),
    (
        a_step_depends_on_nothing_but_state_and_action,
        'let set clear all that a step remembers, or declare "query": "rollout"',
    ),
    (
        restore_returns_to_what_was_saved,
        "put all that a step depends on into the snapshot, or answer save with the code 'unsupported'",
    ),
    (a_program_that_was_started_anew_is_the_same, "keep nothing between two starts of the program"),
)
