"""Tables fit the terminal, whatever its width, and lose nothing on the way."""

from __future__ import annotations

import pytest

from support.terminal import on_terminal
from surrogym_client.cli.columns import ENDLESS, columns, fitted
from surrogym_client.experiments.reproduce.rows import Row, write_rows

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


def test_the_table_of_a_study_fits_a_terminal(tmp_path):
    """The file keeps its wide Markdown."""
    rows = [
        Row("pendulum", "default", seed, 14, 4, 5, 9, mean=-150.0 - seed, min=-400.0, reached=True, seconds=1.0)
        for seed in range(3)
    ]
    write_rows(tmp_path / "rows.csv", rows)
    arguments = ("reproduce", "table", "--rows", "rows.csv", "--out", "both")
    with on_terminal(*arguments, width=80, folder=str(tmp_path)) as terminal:
        terminal.await_text("Commits:")
        assert "worst episode   -400.0" in terminal.shown
        assert max(map(len, terminal.shown.splitlines())) <= 80
    assert max(map(len, (tmp_path / "both" / "efficiency.md").read_text().splitlines())) > 80
