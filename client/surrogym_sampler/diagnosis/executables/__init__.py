"""Checks that a program can serve as an original environment; docs/how-to/executables.md describes its protocol."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from surrogym_sampler.diagnosis.executables.checks import CHECKS
from surrogym_sampler.diagnosis.executables.subject import LeftOut, Subject
from surrogym_sampler.diagnosis.outcomes import Mismatch, Outcome
from surrogym_sampler.original.errors import RequestRefused, StepFailed, UnknownEnvironment
from surrogym_sampler.original.executables.messages import CHECK

FIRST = "spec answers with protocol 1 and a valid specification"


def conformance(command: str, seconds: float) -> Iterator[Outcome]:
    """Run every check in turn on one program, and yield its outcome. Without a valid specification, only the first
    check is made.

    Args:
        command: the program and its arguments, quoted as for a shell.
        seconds: time allowed for each answer.

    Raises:
        UnknownEnvironment: the command is empty, or its quotes don't match.
    """
    with Subject(command, seconds) as subject:
        try:
            subject.start()
        except (UnknownEnvironment, StepFailed) as error:
            yield Outcome(FIRST, f"{_own(error)}; see docs/how-to/executables.md for a first program")
            return
        yield Outcome(FIRST, None)
        for check, way_out in CHECKS:
            yield _outcome(check, way_out, subject)


def _outcome(check: Callable[[Subject], None], way_out: str, subject: Subject) -> Outcome:
    name = check.__name__.replace("_", " ")
    try:
        subject.revive()
        check(subject)
    except LeftOut as why:
        return Outcome(name, None, str(why))
    except RequestRefused as error:
        return Outcome(name, f"expected a result, got an error: {error}; {way_out}")
    except (Mismatch, StepFailed, UnknownEnvironment) as error:
        return Outcome(name, f"{_own(error)}; {way_out}")
    return Outcome(name, None)


def _own(error: Exception) -> str:
    """Return an error's message without the advice to run the checks of this module, because they run already."""
    return str(error).removesuffix(f"; {CHECK}")
