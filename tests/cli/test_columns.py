"""Tables fit the terminal, whatever its width, and lose nothing on the way."""

from __future__ import annotations

from surrogym.cli.columns import columns

ROWS = [("name", "a long heading"), ("pendulum", 0.123456), ("x", None)]


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
