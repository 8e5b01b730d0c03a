"""Tables fit the terminal, whatever its width, and lose nothing on the way."""

from __future__ import annotations

import pytest

from surrogym.cli.columns import ENDLESS, columns, fitted

ROWS = [("name", "a long heading"), ("pendulum", 0.123456), ("x", None)]
MARKDOWN = """\
| task | what was asked | result |
| --- | --- | --- |
| pendulum | mean -160, all upright | reached |
| cartpole | all 500 | - |

A sentence that is broken
where it was not.
"""


def test_headings_are_broken_first():
    assert columns(ROWS).splitlines() == ["name      a long heading", "pendulum  0.1235", "x         -"]
    assert columns(ROWS, 17).splitlines() == [
        "          a long",
        "name      heading",
        "pendulum  0.1235",
        "x         -",
    ]


def test_then_cells():
    assert columns([("name", "words"), ("pendulum", "one two three"), ("x", "four")], 17).splitlines() == [
        "name      words",
        "pendulum  one two",
        "          three",
        "x         four",
    ]


def test_then_rows():
    assert columns(ROWS, 16).splitlines() == [
        "name            pendulum",
        "a long heading  0.1235",
        "",
        "name            x",
        "a long heading  -",
    ]


@pytest.mark.parametrize("width", [30, 40, 60, 80])
def test_markdown_fits_and_keeps_every_word(width):
    shown = fitted(MARKDOWN, width)
    assert max(map(len, shown.splitlines())) <= width
    assert set(MARKDOWN.replace("|", " ").replace("---", "").split()) <= set(shown.split())
    assert "\n\nA sentence that is broken where" in fitted(MARKDOWN, 80).replace("was\n", "was ")


def test_markdown_is_unchanged_in_a_file():
    assert fitted(MARKDOWN, ENDLESS) == MARKDOWN
