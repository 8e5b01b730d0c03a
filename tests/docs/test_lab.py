"""A smoke of the lab: it is there, and a page of results shows its rows. Its own tests are run by ``make lab-test``."""

from pathlib import Path

from support.commands import command_line
from surrogym_lab.commands import build
from surrogym_lab.reproduce.page import present_sections, section
from surrogym_lab.reproduce.rows import read_rows

ROOT = Path(__file__).parents[2]


def test_its_commands_are_there():
    assert {"efficiency", "paper", "table"} <= command_line(build).commands.keys()


def test_the_page_of_results_shows_its_rows():
    rows = read_rows(ROOT / "lab" / "records" / "results" / "efficiency-audited.csv")
    assert present_sections(ROOT / "docs" / "evidence.md") == {"headline": section("headline", rows, ".")}
