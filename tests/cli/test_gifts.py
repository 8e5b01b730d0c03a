"""Files of somebody else: what they hold is neither run nor obeyed."""

from __future__ import annotations

from pathlib import Path

import pytest

from support.gifts import gift

EVALUATE = ("evaluate", "policy.zip", "--env", "Pendulum-v1", "--episodes", "1")
EXPORT = ("export-policy", "policy.zip", "--out", "policy.onnx")


@pytest.fixture
def mark(tmp_path: Path) -> Path:
    return tmp_path / "the gift has run"


@pytest.mark.parametrize("arguments", [EVALUATE, EXPORT])
def test_a_pickled_policy_is_refused_in_one_sentence(surrogym, tmp_path, mark, arguments):
    gift(tmp_path / "policy.zip", mark)
    ended = surrogym(*arguments)
    assert not mark.exists()
    assert (ended.code, ended.out) == (1, "")
    assert ended.err.startswith(
        "error: policy.zip holds pickled objects (policy_class), and reading them would run any"
    )
    assert "give --trust-policy" in ended.err
    assert ended.err.count("\n") == 1


@pytest.mark.parametrize("flag", ["--trust-policy", "--trust"])
@pytest.mark.parametrize("arguments", [EVALUATE, EXPORT])
def test_a_pickled_policy_is_read_when_it_is_trusted(surrogym, tmp_path, mark, arguments, flag):
    gift(tmp_path / "policy.zip", mark)
    assert surrogym(*arguments, flag).code == 1  # it is no policy after all
    assert mark.exists()
