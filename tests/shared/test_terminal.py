"""What commands print: the words of others steer no terminal."""

from __future__ import annotations

import pytest

from surrogym_shared.terminal import give, say


def test_control_characters_in_printed_text_are_escaped_on_the_terminal(capsys: pytest.CaptureFixture[str]):
    """Names, notes and errors come from files and servers: a title set, a screen cleared, a line forged."""
    say("\x1b]0;title\x07\x1b[2J\rok: forged\x9b1m")
    give({}, lambda: "a\x1b[31m\tb\nc", as_json=False)
    out, err = capsys.readouterr()
    assert err == "\\x1b]0;title\\x07\\x1b[2J\\x0dok: forged\\x9b1m\n"
    assert out == "a\\x1b[31m\tb\nc\n"
