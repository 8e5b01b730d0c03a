"""Checks of a program's answers: their form, and the errors for requests that it can't answer."""

from __future__ import annotations

import json

from surrogym_sampler.diagnosis.executables.subject import UNSUPPORTED, Subject
from surrogym_sampler.diagnosis.outcomes import Mismatch, expect
from surrogym_sampler.original.errors import RequestRefused
from surrogym_sampler.original.executables.messages import PROTOCOL, decode, encode

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
)
