"""A smoke of the lab: it is there, and a page of results shows its rows. Its own tests are run by ``make lab-test``."""

from pathlib import Path

from support.commands import command_line
from surrogym_lab.commands import build
from surrogym_lab.reproduce.page import present_sections, section
from surrogym_lab.reproduce.rows import read_rows

ROOT = Path(__file__).parents[2]


def test_the_lab_has_the_commands_efficiency_paper_and_table():
    assert {"efficiency", "paper", "table"} <= command_line(build).commands.keys()


def test_the_evidence_page_shows_the_recorded_result_rows():
    rows = read_rows(ROOT / "lab" / "records" / "results" / "efficiency-audited.csv")
    assert present_sections(ROOT / "docs" / "evidence.md") == {"headline": section("headline", rows, ".")}
