"""Keep the output of environments out of a command's own output, and handle their attempts to end the program."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stdout
from typing import TYPE_CHECKING

from surrogym.cli.errors import CommandError
from surrogym_shared.terminal import say

if TYPE_CHECKING:
    from surrogym_sampler.diagnosis.doctor import Finding


@contextmanager
def prints_aside() -> Iterator[None]:
    """Context in which output of Python code, such as an environment's, goes to standard error.

    Raises:
        CommandError: an environment called ``sys.exit``, such as while it was closed.
    """
    from surrogym_sampler.original.errors import sentence

    with redirect_stdout(sys.stderr):
        try:
            yield
        except SystemExit as error:
            raise CommandError(
                f"the environment ended the program: {sentence(error)}; remove sys.exit there"
            ) from error


@contextmanager
def unregistered(steps: Callable[[], int], what: str) -> Iterator[None]:
    """Context in which an environment's specification is drafted. After Ctrl-C, it prints how many real steps the draft
    took, and raises ``KeyboardInterrupt`` again.

    Args:
        steps: returns the number of real steps that a finished draft took. It is used if the interruption does not tell
            how many steps the draft had taken.
        what: end of the printed sentence, such as "nothing was registered".
    """
    try:
        yield
    except KeyboardInterrupt as interruption:
        taken = getattr(interruption, "steps", steps())
        took = f"after {taken} real steps, which no ledger counts" if taken else "before the first real step"
        say(f"interrupted {took}; {what}")
        raise


def found_aside(findings: Iterator[Finding]) -> Iterator[Finding]:
    """Yield the findings of checks. What an environment prints during a check goes to standard error."""
    while True:
        with prints_aside():
            finding = next(findings, None)
        if finding is None:
            return
        yield finding
