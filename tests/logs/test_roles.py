"""Roles of columns: two columns for one name, and mappings that contradict themselves, are refused in a sentence."""

from __future__ import annotations

from pathlib import Path

import pytest

from surrogym_sampler.logs import UnusableLog
from surrogym_shared.logs.columns import mapping_of, roles_by_mapping, roles_by_name

NAMES = ["x", "y", "v", "r"]
PLAIN = {"state": ["x", "y"], "action": ["v"]}


@pytest.mark.parametrize(
    ("names", "says"),
    [
        (["action_a", "u_a", "x"], "one column for the action 'a', got two: action_a and u_a"),
        (["action", "action_0", "x"], "one column for the action '0', got two: action and action_0"),
        (["state_x", "q.x", "action"], "one column for the state 'x', got two: state_x and q.x"),
        (["x", "next_x", "x_next", "action"], "one column for the next state 'x', got two: next_x and x_next"),
        (["q.x", "next_x", "next_q.x", "action"], "one column for the next state 'x', got two: next_x and next_q.x"),
    ],
)
def test_two_log_columns_for_one_state_or_action_name_are_refused(names: list[str], says: str):
    """The last one won, and the others were lost."""
    with pytest.raises(UnusableLog, match="expected " + says):
        roles_by_name(names)


@pytest.mark.parametrize(
    ("names", "says"),
    [
        (["x", "action", "reward", "r"], "the role reward, got reward and r"),
        (["x", "action", "Reward", "rewards"], "the role reward, got Reward and rewards"),
        (["x", "action", "terminated", "done"], "the role terminated, got terminated and done"),
        (["state_x", "action", "t", "time"], "the role time, got t and time"),
    ],
)
def test_two_log_columns_for_one_role_are_refused(names: list[str], says: str):
    """One of them was taken, and the other became a state."""
    with pytest.raises(UnusableLog, match=f"expected one column for {says}: rename one, or name the columns in a map"):
        roles_by_name(names)


def test_log_column_names_are_case_sensitive():
    roles = roles_by_name(["T", "t", "R", "r", "action"])
    assert (roles.time, roles.reward, list(roles.state)) == ("t", "r", ["T", "R"])


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"reward": "x"}, "one role for the column 'x', got state x and reward"),
        ({"reward": "r", "time": "r"}, "one role for the column 'r', got reward and time"),
        ({"state": {"a": "x", "b": "x"}}, "one role for the column 'x', got state a and state b"),
        ({"state": ["x", "x"]}, "one role for the column 'x', got state x and state x"),
        ({"state": ["x"], "next": {"x": "x"}}, "one role for the column 'x', got state x and next state x"),
        ({"angles": ["v"]}, r"names 'v' in angles: expected one of the states \['x', 'y'\]"),
        ({"constants": ["z"]}, "names 'z' in constants: expected one of the states"),
        ({"limits": {"z": [0, 1]}}, "names 'z' in limits: expected one of"),
        ({"angles": ["x"], "constants": ["x"]}, "'x' in angles or in constants, got it in both"),
        ({"limits": {"x": [2, -2]}}, r"limits of 'x' with the lowest value first, got \[2.0, -2.0\]"),
        ({"limits": {"x": [0, 0]}}, "limits of 'x' with the lowest value first"),
        ({"limits": {"x": [float("nan"), 1]}}, "limits of 'x' to be at most 1e.12 in size"),
        ({"limits": {"v": [float("-inf"), None]}}, "limits of 'v' to be at most 1e.12 in size"),
        (
            {"state": {"v": "x"}, "limits": {"v": [0, 1]}},
            "limits of a state or of an action, got 'v', which is both",
        ),
    ],
)
def test_a_mapping_that_contradicts_itself_is_refused(changes: dict[str, object], says: str):
    with pytest.raises(UnusableLog, match="the mapping.*" + says):
        roles_by_mapping(mapping_of(PLAIN | changes, "the mapping"), NAMES)


def test_the_mapping_of_recognised_columns_gives_the_same_roles_again():
    """The server tells a page the roles of the columns. The page sends them back, and the roles stay the same."""
    names = ["x", "next_x", "action_x", "reward", "time"]
    roles = roles_by_name(names)
    assert roles_by_mapping(mapping_of(roles.mapping.model_dump(), "the page"), names) == roles


@pytest.mark.parametrize(
    ("name", "content", "says"),
    [
        ("map.toml", b"\xff\xfe\x00state", "expected JSON or TOML in .*, got other bytes than UTF-8"),
        ("map.json", b"[" * 100_000, "expected a table of columns in .*nested too deeply"),
        ("map.json", b"[" * 4_000 + b"]" * 4_000, "expected a table"),
        ("map.toml", b"a=" + b"[" * 100_000, "nested too deeply|expected JSON or TOML"),
    ],
)
def test_a_mapping_file_that_cant_be_read_is_refused_in_a_sentence(
    tmp_path: Path, name: str, content: bytes, says: str
):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(UnusableLog, match=says):
        mapping_of(tmp_path / name, "the file")


def test_a_next_state_column_is_matched_by_the_whole_state_name():
    """next.q_0 was the next value of a state called 0, although the state q_0 was there."""
    assert roles_by_name(["q.q_0", "next.q_0", "action"]).following == {"q_0": "next.q_0"}
    assert roles_by_name(["q_0", "next.q_0", "action"]).following == {"0": "next.q_0"}
