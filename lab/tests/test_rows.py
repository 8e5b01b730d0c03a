"""Rows survive the file, and merge without losing a seed or hiding an error."""

from dataclasses import replace

import pytest

from support.metrics import METRICS
from surrogym_lab.reproduce.rows import Row, UnusableRows, merge, read_rows, row_of, write_rows

ROW = Row("pendulum", "default", 0, 14, 4, 5, 9, mean=-150.123, success=0.97, reached=True, phase="ready")


def test_a_result_row_contains_the_metrics_of_its_run():
    row = row_of(METRICS)
    assert row.key == ("pendulum", "default", 14, 3)
    assert (row.real_steps, row.failures, row.also_success, row.seconds) == (9, 7, 0.9, 50.0)
    assert (row.promise, row.promise_low, row.promise_high) == (-144.0, -160.0, -130.0)
    assert (row.trusted, row.audit_steps, row.without) == (True, 8, METRICS["without"]["mean"])
    assert row_of({**METRICS, "promise": None, "trusted": None}).trusted is None, "learned without a surrogate"
    assert row_of({**METRICS, "also": None, "success_rate": None}).failures is None


def test_result_rows_survive_writing_and_reading(tmp_path):
    rows = [
        replace(ROW, trusted=False, promise=-150.0),
        Row("cartpole", "paper", 1, 8, error="exit code 1: no, nothing"),
    ]
    write_rows(tmp_path / "rows.csv", rows)
    assert read_rows(tmp_path / "rows.csv") == rows
    assert read_rows(tmp_path / "none.csv") == []


def test_two_concurrent_writers_of_a_result_file_lose_no_rows(tmp_path):
    """Two studies may share a folder. The second writer moved the first one's partial file away."""

    def rows(last):
        for seed in range(3):
            yield replace(ROW, seed=seed)
            if last and seed == 0:
                write_rows(tmp_path / "rows.csv", rows(last=False))

    write_rows(tmp_path / "rows.csv", rows(last=True))
    assert [row.seed for row in read_rows(tmp_path / "rows.csv")] == [0, 1, 2]
    assert [path.name for path in tmp_path.iterdir()] == ["rows.csv"]


def test_a_failed_write_leaves_the_result_file_unchanged(tmp_path):
    def broken():
        yield ROW
        raise RuntimeError("no more")

    write_rows(tmp_path / "rows.csv", [ROW])
    with pytest.raises(RuntimeError, match="no more"):
        write_rows(tmp_path / "rows.csv", broken())
    assert read_rows(tmp_path / "rows.csv") == [ROW]
    assert [path.name for path in tmp_path.iterdir()] == ["rows.csv"]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (("seed", "sead"), "expected the columns task, arm, seed"),
        (("pendulum,default,0", "pendulum,default,zero"), "line 2: invalid literal"),
        ((",yes,", ",maybe,"), "line 2: expected yes or no, got 'maybe'"),
    ],
)
def test_a_csv_file_with_other_columns_is_refused_as_result_file(tmp_path, change, words):
    path = tmp_path / "rows.csv"
    write_rows(path, [ROW])
    path.write_text(path.read_text().replace(*change, 1))
    with pytest.raises(UnusableRows, match=words):
        read_rows(path)


@pytest.mark.parametrize(
    ("content", "words"), [(b"task,arm\xff\n", "expected a CSV file in UTF-8"), (b"", "got an empty one")]
)
def test_a_binary_or_empty_result_file_is_refused(tmp_path, content, words):
    (tmp_path / "rows.csv").write_bytes(content)
    with pytest.raises(UnusableRows, match=words):
        read_rows(tmp_path / "rows.csv")


def test_when_merging_results_later_rows_replace_earlier_ones_unless_they_are_errors():
    better, bad, other = replace(ROW, mean=-140.0), replace(ROW, mean=None, error="died"), replace(ROW, seed=1)
    assert merge([ROW], [better, other]) == [better, other]
    assert merge([ROW], [bad]) == [ROW]
    assert merge([bad], [ROW]) == [ROW]
    assert merge([replace(ROW, budget=7)], [ROW]) == [replace(ROW, budget=7), ROW]
