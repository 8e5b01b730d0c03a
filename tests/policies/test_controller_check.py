"""A stored check of a controller is read as it was written, and impossible ones are refused."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from surrogym_trainer.policies.controller_check import FILE, StoredCheck, UnusableCheck, read_check, write_check

POLICY = "5a" * 32


def check() -> StoredCheck:
    counts = {"episodes": 2, "steps": 400, "different_actions": 0, "faults": 1}
    returns = {"mean_return": -1.0, "mean_return_of_policy": -1.5}
    return StoredCheck(
        target="c", environment="here", policy=POLICY, largest_difference=1e-9, microseconds=2.0, **counts, **returns
    )


def test_a_stored_controller_check_is_read_back_unchanged(tmp_path: Path):
    write_check(tmp_path, check())
    assert read_check(tmp_path, POLICY) == check()


@pytest.mark.parametrize(
    "changes",
    [{"faults": -1}, {"faults": True}, {"steps": 10**40}, {"largest_difference": -1.0}, {"microseconds": -1.0}],
)
def test_an_invalid_stored_controller_check_is_refused(tmp_path: Path, changes: dict[str, object]):
    (tmp_path / FILE).write_text(json.dumps(check().model_dump() | changes))
    with pytest.raises(UnusableCheck, match="not the check"):
        read_check(tmp_path, POLICY)


def test_a_too_long_controller_check_file_is_refused_by_its_size(tmp_path: Path):
    (tmp_path / FILE).write_text(check().model_dump_json() + " " * 100_000)
    with pytest.raises(UnusableCheck, match="at most 65536 bytes"):
        read_check(tmp_path, POLICY)
