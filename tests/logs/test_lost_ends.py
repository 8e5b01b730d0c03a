"""Ends of episodes in logs with and without next states: used, or named with what follows."""

from __future__ import annotations

import numpy as np

from surrogym_shared.logs.checking import ReadLog, draft_log
from surrogym_shared.logs.columns import roles_by_name
from surrogym_shared.logs.table import Floats, Table

DRAWS = range(20)


def read(columns: dict[str, Floats]) -> ReadLog:
    table = Table(columns, np.arange(2, 2 + len(columns["x"])))
    return draft_log(table, roles_by_name(table.names), "drawn")


def test_every_logged_termination_is_used_or_reported_as_lost():
    """30 of 30 ends were lost without a word, and a draft that never ends promised 55 where 9.3 came."""
    for seed in DRAWS:
        rng = np.random.default_rng(seed)
        lengths = rng.integers(2, 20, int(rng.integers(2, 12)))
        rows, last = int(lengths.sum()), np.cumsum(lengths) - 1
        terminated = np.zeros(rows)
        terminated[last[rng.random(len(last)) < 0.6]] = 1
        u, ends = rng.uniform(-1, 1, rows), int(terminated.sum())
        x = np.cumsum(u)
        columns = {"x": x, "action_u": u, "reward": -x, "terminated": terminated}
        columns["episode"] = np.repeat(np.arange(len(lengths)), lengths)
        log = read(columns)
        assert (int(log.steps.terminated.sum()), log.steps.lost_ends) == (0, ends)
        notes = [note for note in log.notes if note.startswith("terminated:")]
        assert [str(ends) in note and "never ends" in note for note in notes] == [True] * (ends > 0)
        whole = read(columns | {"next_x": x + u})
        assert (int(whole.steps.terminated.sum()), whole.steps.lost_ends) == (ends, 0)
        assert not any(note.startswith("terminated:") for note in whole.notes)
        assert whole.spec.termination == ("learned" if ends else ())
