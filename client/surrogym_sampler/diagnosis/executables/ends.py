"""Checks that a program ends on the request ``close``, and when its standard input ends."""

from __future__ import annotations

from surrogym_sampler.diagnosis.executables.subject import Subject
from surrogym_sampler.diagnosis.outcomes import Mismatch, expect

END_SECONDS = 2.0


def the_end_of_its_input_ends_the_program(subject: Subject) -> None:
    subject.program.end_input()
    _exit_code(subject)


def close_ends_the_program(subject: Subject) -> None:
    expect("result of close", {}, subject.ask("close"))
    expect("exit code", 0, _exit_code(subject))


def _exit_code(subject: Subject) -> int:
    code = subject.program.wait(END_SECONDS)
    subject.program.end()
    if code is None:
        raise Mismatch(f"expected the program to end within {END_SECONDS:g} s, got one that still runs")
    return code


CHECKS = (
    (
        the_end_of_its_input_ends_the_program,
        "end where there is no further line: the program would outlive a sampler that is killed",
    ),
    (close_ends_the_program, "answer close with an empty object, and exit with code 0"),
)
