"""Prints of environments, kept out of a command's own output, and their attempts to end it."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stdout
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from surrogym_sampler.diagnosis.doctor import Finding


@contextmanager
def prints_aside() -> Iterator[None]:
    """While this is entered, what Python code of an environment prints goes to standard error.

    Raises:
        CommandError: an environment called ``sys.exit`` where nothing else tells of it, such as while it was closed.
    """
    from surrogym.cli.errors import CommandError
    from surrogym_sampler.original.errors import sentence

    with redirect_stdout(sys.stderr):
        try:
            yield
        except SystemExit as error:
            raise CommandError(f"the environment ended the program: {sentence(error)}") from error


@contextmanager
def unregistered(steps: Callable[[], int], what: str) -> Iterator[None]:
    """Context that says after Ctrl-C how many real steps a description took, and what did not come of it. It raises the
    interruption again.

    Args:
        steps: gives the real steps of a description that has ended.
        what: what was not done, such as "nothing was registered".
    """
    from surrogym_shared.terminal import say

    try:
        yield
    except KeyboardInterrupt as interruption:
        taken = getattr(interruption, "steps", steps())
        took = f"after {taken} real steps, which no ledger counts" if taken else "before the first real step"
        say(f"interrupted {took}; {what}")
        raise


def found_aside(findings: Iterator[Finding]) -> Iterator[Finding]:
    """Return the findings; what an environment prints while one is made goes to standard error."""
    while True:
        with prints_aside():
            finding = next(findings, None)
        if finding is None:
            return
        yield finding
