"""A log without enough usable steps says why, and leaves its rejected rows in a file."""

from __future__ import annotations

import csv
import pickle
from pathlib import Path

import pytest

from support import reactor
from surrogym_sampler.logs import UnusableLog, import_log, read_log
from surrogym_sampler.logs.importing import Options
from surrogym_shared.logs.transitions import TooFewSteps


def said(path: Path, text: str) -> str:
    path.write_text(text)
    with pytest.raises(UnusableLog) as refused:
        import_log(path)
    return str(refused.value)


def test_a_log_with_too_few_usable_rows_names_the_most_frequent_reason(tmp_path: Path):
    rows = ["0.1,", "0.2,x", "0.3,y", "0.4,z"]
    words = said(tmp_path / "log.csv", "\n".join(["level,action", *rows]) + "\n")
    assert words.startswith("expected two usable steps at least, got 0 of 4 rows; ")
    assert "4 rows can't be used, 3 of them for the same reason, first in line 3: " in words
    assert "action: expected a number, got 'x'" in words
    assert words.endswith(f"all of these rows are in {tmp_path / 'log.rejected.csv'}")
    kept = list(csv.reader((tmp_path / "log.rejected.csv").read_text().splitlines()))
    assert [row[0] for row in kept] == ["line", "2", "3", "4", "5"]


def test_a_log_with_decimal_commas_and_semicolons_is_refused_with_the_cause(tmp_path: Path):
    words = said(tmp_path / "log.csv", "level;action\n0,1;1,5\n0,2;1,0\n0,3;0,5\n")
    assert "the columns are separated by ';', and the numbers have a decimal comma: write a point" in words


def test_a_log_with_decimal_commas_and_comma_separators_is_refused_with_the_cause(tmp_path: Path):
    words = said(tmp_path / "log.csv", "level,action\n0,1,1,5\n0,2,1,0\n")
    assert "expected 2 columns, got 4" in words
    assert "the columns are separated by ',': numbers need a decimal point, not a comma" in words


def test_a_log_of_two_rows_is_refused_because_the_last_has_no_next_state(tmp_path: Path):
    words = said(tmp_path / "log.csv", "level,action\n0.1,1\n0.2,0\n")
    assert words.startswith("expected two usable steps at least, got 1 of 2 rows; 1 row has no next state")
    assert not (tmp_path / "log.rejected.csv").exists()


def test_a_log_that_contradicts_its_specification_in_all_rows_is_refused(tmp_path: Path):
    whole = reactor.log(runs=1, length=5)
    spec = read_log(whole.write(tmp_path / "a.csv")).spec
    for row in range(5):
        whole = whole.at(row, "terminated", "1")
    with pytest.raises(TooFewSteps, match="expected one usable step at least, got 0 of 5 rows") as refused:
        read_log(whole.write(tmp_path / "b.csv"), Options(spec=spec))
    assert str(pickle.loads(pickle.dumps(refused.value))) == str(refused.value)
