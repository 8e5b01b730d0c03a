"""Checks of a program: the form of its answers, its errors for requests that it can't answer, its states, and its end.

The states are those after resets, states that are set, and snapshots. A program ends on the request ``close``, and when
its standard input ends. If the specification declares limits, the fallback controller then has to act first.

Shapes: C coordinates.
"""

from __future__ import annotations

import json

import numpy as np

from surrogym_sampler.diagnosis.access import CLOSE, EXACT, apart
from surrogym_sampler.diagnosis.executables.subject import UNSUPPORTED, LeftOut, Subject
from surrogym_sampler.diagnosis.outcomes import Mismatch, expect
from surrogym_sampler.original.errors import RequestRefused
from surrogym_sampler.original.executables.messages import PROTOCOL, action_entries, decode, encode, short, text, truth
from surrogym_sampler.original.limits import MOST_STEPS, rest_seconds
from surrogym_sampler.original.protocol import Array
from surrogym_shared.spec import Fixed, limits

NUMBERS = (1_000_003, 17)  # arbitrary ids of requests, which the answers must repeat
NONSENSE = b"this is no request\n"
SURPLUS_SECONDS = 0.2
STEPS = 3


def an_answer_repeats_the_number_of_its_request(subject: Subject) -> None:
    for number in NUMBERS:
        decode(subject.program.exchange(encode(number, "reset", seed=0), "reset", subject.deadline), number)


def a_newer_protocol_is_not_accepted(subject: Subject) -> None:
    try:
        result = subject.ask("spec", protocol=PROTOCOL + 1)
    except RequestRefused:
        return
    expect(f"protocol in the answer to protocol {PROTOCOL + 1}", PROTOCOL, result.get("protocol"))


def an_unknown_method_is_unsupported(subject: Subject) -> None:
    expect("code of the error", UNSUPPORTED, subject.refused("conformance").code)
    subject.reset(0)


def a_line_that_is_no_request_gets_an_error(subject: Subject) -> None:
    line = subject.program.exchange(NONSENSE, "a line that is no request", subject.deadline)
    try:
        answer = json.loads(line)
    except ValueError as error:
        raise Mismatch(f"expected one line of JSON from the program, got {line[:80]!r}") from error
    if not isinstance(answer, dict) or answer.get("id", 0) is not None or "error" not in answer:
        raise Mismatch(
            f"expected the answer to a line without a request to be an error whose id is null, got {line[:80]!r}"
        )
    subject.reset(0)


def a_step_without_an_action_gets_an_error(subject: Subject) -> None:
    subject.begin()
    subject.refused("step")
    subject.begin()
    subject.step(subject.random_action())


def a_step_gives_state_reward_and_ends(subject: Subject) -> None:
    for _ in range(STEPS):
        subject.begin()
        subject.step(subject.random_action())


def nothing_but_answers_is_printed(subject: Subject) -> None:
    subject.begin()
    surplus = subject.program.surplus(SURPLUS_SECONDS)
    if surplus:
        subject.program.end()
        raise Mismatch(f"expected one printed line for each request, got a further line: {surplus[:80]!r}")


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


END_SECONDS = 2.0
EXAMPLE = '{"fallback": 12}'  # last line that a program prints after 12 steps of its fallback controller
ACTIONS = 3  # number of random actions before the input ends and the fallback controller has to act


def the_end_of_its_input_ends_the_program(subject: Subject) -> None:
    subject.program.end_input()
    _exit_code(subject, rest_seconds(subject.spec))


def without_input_the_fallback_of_limits_acts(subject: Subject) -> None:
    if subject.spec.limits is None:
        raise LeftOut("the program's specification declares no limits")
    if not any(_in_motion(subject, seed) for seed in range(SEEDS)):
        raise LeftOut(
            f"all {SEEDS} test episodes ended within {ACTIONS} random steps, so the end of the input could not be "
            "tested within an episode"
        )
    seconds = rest_seconds(subject.spec) + subject.seconds
    subject.program.end_input()
    subject.program.surplus(seconds)
    ended, printed = subject.program.wait(END_SECONDS), subject.program.surplus(0.0).strip()
    subject.program.end()
    if not printed:
        did = f"still ran after {seconds:g} s" if ended is None else f"ended with exit code {ended}"
        raise Mismatch(f"expected a line such as {EXAMPLE}, got none from a program that {did}")
    if not 1 <= _steps(printed) <= MOST_STEPS:
        raise Mismatch(f"expected one line such as {EXAMPLE} with 1 to {MOST_STEPS} steps, got {short(printed)}")
    if ended is None:
        raise Mismatch(
            f"expected the program to end within {END_SECONDS:g} s after this line, got a program that still runs"
        )


def close_ends_the_program(subject: Subject) -> None:
    expect("result of close", {}, subject.ask("close"))
    expect("exit code", 0, _exit_code(subject))


def _exit_code(subject: Subject, more_seconds: float = 0.0) -> int:
    seconds = END_SECONDS + more_seconds
    code = subject.program.wait(seconds)
    subject.program.end()
    if code is None:
        raise Mismatch(f"expected the program to end within {seconds:g} s, got a program that still runs")
    return code


def _in_motion(subject: Subject, seed: int) -> bool:
    """Begin an episode, take ``ACTIONS`` random steps, and return whether the episode continues."""
    subject.reset(seed)
    for _ in range(ACTIONS):
        reply = subject.ask("step", action=action_entries(subject.spec.action, subject.random_action()))
        if truth(reply, "terminated") or truth(reply, "truncated"):
            return False
    return True


def _steps(line: bytes) -> int:
    """Return the number of steps of the fallback controller that a printed line states; 0 if it states none."""
    try:
        steps = json.loads(line)["fallback"]
    except (ValueError, LookupError, TypeError, RecursionError):
        return 0
    return steps if type(steps) is int else 0


CHECKS = (
    (an_answer_repeats_the_number_of_its_request, "copy 'id' from the request into the answer"),
    (a_newer_protocol_is_not_accepted, "answer spec with the protocol that the program speaks, or with an error"),
    (an_unknown_method_is_unsupported, "answer it with an error whose code is 'unsupported', and keep running"),
    (
        a_line_that_is_no_request_gets_an_error,
        'answer it with {"id": null, "error": "...", "code": "invalid"}, and keep running',
    ),
    (a_step_gives_state_reward_and_ends, "give all four fields in every answer to step"),
    (a_step_without_an_action_gets_an_error, "answer a request that lacks a field with an error, and keep running"),
    (nothing_but_answers_is_printed, "print everything else to standard error"),
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
    (
        the_end_of_its_input_ends_the_program,
        "end where there is no further line: the program would outlive a sampler that is killed",
    ),
    (
        without_input_the_fallback_of_limits_acts,
        "after the end of its input without close, let the program apply the fallback of its limits until the machine "
        "rests, then print this line and end",
    ),
    (close_ends_the_program, "answer close with an empty object, and exit with code 0"),
)
