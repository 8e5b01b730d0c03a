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


def test_a_table_wider_than_the_terminal_first_wraps_its_headings():
    assert columns(ROWS).splitlines() == ["name      a long heading", "pendulum  0.1235", "x         -"]
    assert columns(ROWS, 17).splitlines() == [
        "          a long",
        "name      heading",
        "pendulum  0.1235",
        "x         -",
    ]


def test_a_table_still_too_wide_for_the_terminal_wraps_its_cells():
    assert columns([("name", "words"), ("pendulum", "one two three"), ("x", "four")], 17).splitlines() == [
        "name      words",
        "pendulum  one two",
        "          three",
        "x         four",
    ]


def test_a_table_too_wide_even_when_wrapped_is_printed_row_by_row():
    assert columns(ROWS, 16).splitlines() == [
        "name            pendulum",
        "a long heading  0.1235",
        "",
        "name            x",
        "a long heading  -",
    ]


@pytest.mark.parametrize("width", [30, 40, 60, 80])
def test_markdown_is_wrapped_to_the_terminal_width_without_losing_words(width):
    shown = fitted(MARKDOWN, width)
    assert max(map(len, shown.splitlines())) <= width
    assert set(MARKDOWN.replace("|", " ").replace("---", "").split()) <= set(shown.split())
    assert "\n\nA sentence that is broken where" in fitted(MARKDOWN, 80).replace("was\n", "was ")


def test_markdown_written_to_a_file_is_not_wrapped():
    assert fitted(MARKDOWN, ENDLESS) == MARKDOWN
