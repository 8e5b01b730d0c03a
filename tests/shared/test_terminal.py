"""What commands print: the words of others steer no terminal."""

from __future__ import annotations

import os
import pty
import re
import sys
import time

import pytest

from surrogym_shared.terminal import give, progress, say


def test_control_characters_in_printed_text_are_escaped_on_the_terminal(capsys: pytest.CaptureFixture[str]):
    """Names, notes and errors come from files and servers: a title set, a screen cleared, a line forged."""
    say("\x1b]0;title\x07\x1b[2J\rok: forged\x9b1m")
    give({}, lambda: "a\x1b[31m\tb\nc", as_json=False)
    out, err = capsys.readouterr()
    assert err == "\\x1b]0;title\\x07\\x1b[2J\\x0dok: forged\\x9b1m\n"
    assert out == "a\\x1b[31m\tb\nc\n"


def test_words_that_come_too_soon_after_a_line_are_shown_later(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A planner's audit said for two minutes that it waited for the sampler."""
    monkeypatch.setattr("surrogym_shared.terminal.FIRST_SECONDS", 0.0)
    monkeypatch.setattr("surrogym_shared.terminal.PLAIN_SECONDS", 0.5)
    shown = ""
    with progress("train") as update:
        update(None, "takes steps")
        update(None, "compares")
        for _ in range(100):
            shown += capsys.readouterr().err
            if "compares" in shown:
                break
            time.sleep(0.1)
    assert shown.endswith("train: compares\n")


@pytest.mark.parametrize(("columns", "bar"), [(40, 10), (80, 20), (160, 24)])
def test_a_narrow_terminal_cuts_off_the_words_and_leaves_the_bar(
    columns: int, bar: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A bar of two characters does not show how much is done."""
    ours, theirs = pty.openpty()
    monkeypatch.setenv("COLUMNS", str(columns))
    monkeypatch.setenv("TERM", "xterm")
    with os.fdopen(theirs, "w") as stderr, monkeypatch.context() as context:
        context.setattr(sys, "stderr", stderr)
        with progress("train") as update:
            update(1.0, "[promise] " + "whole virtual episodes, and " * 5)
    written = b""
    while b"\x1b[?25h" not in written:  # the cursor is shown again at the end
        written += os.read(ours, 100_000)
    os.close(ours)
    lines = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", written.decode()).split("\r")
    shown = [line for line in lines if "train" in line][-1]
    assert shown.count("━") == bar
    assert "[promise]" in shown
    assert re.search(r"\d:\d\d:\d\d$", shown.rstrip())
