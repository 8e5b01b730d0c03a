"""Prints of environments, kept out of a command's own output."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import AbstractContextManager, redirect_stdout
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from surrogym_client.diagnosis.doctor import Finding


def prints_aside() -> AbstractContextManager[object]:
    """While this is entered, what Python code of an environment prints goes to standard error."""
    return redirect_stdout(sys.stderr)


def found_aside(findings: Iterator[Finding]) -> Iterator[Finding]:
    """The same findings. What an environment prints while one is made goes to standard error."""
    while True:
        with prints_aside():
            finding = next(findings, None)
        if finding is None:
            return
        yield finding
