"""Actions of whole numbers: drafted as choices, or asked about; never amounts without a word."""

from __future__ import annotations

import numpy as np
import pytest

from surrogym_shared.logs.checking import ReadLog, check_log, draft_log
from surrogym_shared.logs.columns import mapping_of, roles_by_mapping, roles_by_name
from surrogym_shared.logs.table import Floats, Table, UnusableLog
from surrogym_shared.spec import BoxAction, DiscreteAction, EnvironmentSpec, MultiDiscreteAction

DRAWS = range(20)


def read(actions: dict[str, Floats], spec: EnvironmentSpec | None = None, **mapping) -> ReadLog:
    rows = len(next(iter(actions.values())))
    x = np.cumsum(0.1 * sum(actions.values()) + 0.05)
    columns = {"x": x, **{f"action_{name}": values for name, values in actions.items()}, "reward": -x}
    table = Table(columns, np.arange(2, 2 + rows))
    roles = roles_by_name(table.names)
    if mapping:
        roles = roles_by_mapping(mapping_of(roles.mapping.model_dump() | mapping, "the mapping"), table.names)
    return draft_log(table, roles, "drawn") if spec is None else check_log(table, roles, spec)


def drawn(rng: np.random.Generator, codes: Floats) -> Floats:
    return np.r_[codes, rng.choice(codes, 60)]


def asked(log: ReadLog) -> list[str]:
    return [note for note in log.notes if note.startswith("action") and "mapping file (--map)" in note]


def test_a_draft_asks_whether_integer_actions_not_numbered_from_0_are_discrete():
    """{1, 2, 3}, {0, 2, 3} and {-1, 0, 1} were amounts without a word."""
    for seed in DRAWS:
        rng = np.random.default_rng(seed)
        codes = np.sort(rng.choice(np.arange(-3, 12), int(rng.integers(2, 6)), replace=False)).astype(float)
        values = drawn(rng, codes)
        log = read({"switch": values})
        if np.array_equal(codes, np.arange(len(codes))):
            assert log.spec.action == DiscreteAction(n=len(codes))
            continue
        assert isinstance(log.spec.action, BoxAction)
        [question] = asked(log)
        shown = ", ".join(f"{code:g}" for code in codes)
        assert f"discrete = {{ switch = [{shown}] }}" in question
        said = read({"switch": values}, discrete={"switch": codes.tolist()})
        assert said.spec.action == DiscreteAction(n=len(codes))
        np.testing.assert_array_equal(codes[said.steps.u[:, 0].astype(int)], values[:-1])
        assert any(f"0 is {codes[0]:g}, 1 is {codes[1]:g}" in note for note in said.notes)
        with pytest.raises(UnusableLog, match="choices"):
            read({"switch": values}, said.spec)
        again = read({"switch": values}, said.spec, discrete={"switch": codes.tolist()})
        np.testing.assert_array_equal(again.steps.u, said.steps.u)
        amounts = read({"switch": values}, discrete=False)
        assert isinstance(amounts.spec.action, BoxAction)
        assert not asked(amounts)


def test_several_integer_action_columns_are_drafted_as_discrete_or_raise_a_question():
    for seed in DRAWS:
        rng = np.random.default_rng(seed)
        counts, low = rng.integers(2, 5, 2), int(rng.integers(0, 2))
        log = read(
            {
                name: drawn(rng, np.arange(low, low + count, dtype=float))[:60]
                for name, count in zip("ab", counts, strict=True)
            }
        )
        if low:
            assert isinstance(log.spec.action, BoxAction)
            assert len(asked(log)) == 1
        else:
            assert log.spec.action == MultiDiscreteAction(nvec=tuple(counts.tolist()))


def test_a_draft_asks_whether_one_hot_action_columns_are_discrete():
    for seed in DRAWS:
        rng = np.random.default_rng(seed)
        count = int(rng.integers(2, 6))
        chosen = np.eye(count)[drawn(rng, np.arange(count)).astype(int)]
        log = read({str(i): chosen[:, i] for i in range(count)})
        assert isinstance(log.spec.action, BoxAction)
        assert len(asked(log)) == 1


def test_an_integer_action_beside_a_continuous_one_is_reported():
    for seed in DRAWS:
        rng = np.random.default_rng(seed)
        values = drawn(rng, np.arange(3.0))
        log = read({"gear": values, "flow": rng.uniform(0, 1, len(values))})
        assert isinstance(log.spec.action, BoxAction)
        assert any("gear of 0, 1, 2" in note for note in log.notes)


def test_a_row_with_an_undeclared_discrete_action_is_set_aside():
    values = np.r_[np.tile([1.0, 2.0, 3.0], 20), 7.0, 1.0]
    log = read({"switch": values}, discrete={"switch": [1, 2, 3]})
    assert [reason for _, reason in log.rejected] == ["action_switch: expected one of [1.0, 2.0, 3.0], got 7"]


@pytest.mark.parametrize("discrete", [{"other": [1, 2]}, {"switch": [1, 1]}, {"switch": [1]}])
def test_declared_discrete_values_that_fit_no_action_are_refused(discrete: dict[str, list[int]]):
    with pytest.raises(UnusableLog, match="discrete"):
        read({"switch": np.tile([1.0, 2.0], 20)}, discrete=discrete)


@pytest.mark.parametrize("spec", [DiscreteAction(n=3), MultiDiscreteAction(nvec=(3,))])
@pytest.mark.parametrize("codes", [[1, 2, 3], [1, 2], [0, 2, 3], [-1, 0, 1], [0.5, 1, 1.5]])
def test_a_log_whose_action_codes_do_not_match_the_specification_is_refused(
    spec: DiscreteAction | MultiDiscreteAction, codes: list[float]
):
    """A log of 1, 2, 3 lost its rows with 3, and its rows with 1 and 2 became those of the second and third choice."""
    numbered = read({"switch": np.tile([0.0, 1.0, 2.0], 20)}).spec.model_copy(update={"action": spec})
    values = np.tile(np.array(codes, dtype=float), 20)
    with pytest.raises(UnusableLog, match=r"choices from 0 to 2.*discrete = \{ switch = \["):
        read({"switch": values}, numbered)


def test_declared_discrete_values_determine_the_meaning_of_action_codes():
    numbered = read({"switch": np.tile([0.0, 1.0, 2.0], 20)}).spec
    values = np.tile([1.0, 2.0], 20)
    np.testing.assert_array_equal(read({"switch": values}, numbered, discrete=True).steps.u[:, 0], values[:-1])
    later = read({"switch": values}, numbered, discrete={"switch": [1, 2, 3]})
    np.testing.assert_array_equal(later.steps.u[:, 0], values[:-1] - 1)
    with pytest.raises(UnusableLog, match="expected 3 choices"):
        read({"switch": values}, numbered, discrete={"switch": [1, 2]})


def test_a_row_with_an_out_of_range_discrete_action_is_set_aside():
    numbered = read({"switch": np.tile([0.0, 1.0, 2.0], 20)}).spec
    few = read({"switch": np.r_[np.tile([0.0, 1.0], 20), 0.0]}, numbered)
    assert not few.rejected, "a log need not show every choice"
    log = read({"switch": np.r_[np.tile([0.0, 1.0, 2.0], 20), 7.0, 1.0]}, numbered)
    assert len(log.rejected) == 1
