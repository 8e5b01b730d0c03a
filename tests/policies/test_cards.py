"""A policy's card never takes the place of another kind of file."""

from __future__ import annotations

from pathlib import Path

import pytest

from surrogym_trainer.policies.card import PolicyCard, UnusablePolicy, require_place, write_card


@pytest.mark.parametrize("content", ["{}", '{"model": "cstr"}', "[1, 2]", "3", "level, valve", ""])
def test_writing_a_policy_description_never_replaces_an_unrelated_file(content: str, tmp_path: Path) -> None:
    other = tmp_path / "tank.json"
    other.write_text(content)
    with pytest.raises(UnusablePolicy, match=r"tank\.json, which is not a card: choose another name"):
        require_place(tmp_path / "tank.zip")
    assert other.read_text() == content


def test_writing_a_policy_description_replaces_an_earlier_one(tmp_path: Path) -> None:
    policy = tmp_path / "tank.zip"
    require_place(policy)
    write_card(policy, PolicyCard())
    require_place(policy)


def test_a_folder_is_refused_as_the_file_of_a_policy(tmp_path: Path) -> None:
    with pytest.raises(UnusablePolicy, match=r"expected a file for the policy, got the folder .*: add a file name"):
        require_place(tmp_path)


def test_a_place_where_no_file_can_be_created_is_refused_before_a_training_is_lost(tmp_path: Path) -> None:
    (tmp_path / "log.csv").touch()
    with pytest.raises(UnusablePolicy, match=r"got .*x\.zip: no file can be created in .*log\.csv \(Not a directory\)"):
        require_place(tmp_path / "log.csv" / "x.zip")
    require_place(tmp_path / "new" / "folder" / "x.zip")
    assert [path.name for path in tmp_path.iterdir()] == ["log.csv"]
