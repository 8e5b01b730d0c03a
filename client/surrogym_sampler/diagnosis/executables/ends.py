"""Checks that a program ends on the request ``close``, and when its standard input ends. If the specification
declares limits, the fallback controller then has to act first."""

from __future__ import annotations

import json

from surrogym_sampler.diagnosis.executables.subject import LeftOut, Subject
from surrogym_sampler.diagnosis.outcomes import Mismatch, expect
from surrogym_sampler.original.executables.messages import action_entries, short, truth
from surrogym_sampler.original.limits.guard import MOST_STEPS, rest_seconds

END_SECONDS = 2.0
EXAMPLE = '{"fallback": 12}'  # last line that a program prints after 12 steps of its fallback controller
ACTIONS = 3  # number of random actions before the input ends and the fallback controller has to act
SEEDS = 5


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
