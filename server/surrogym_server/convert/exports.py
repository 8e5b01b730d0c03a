"""Samples as files that ``surrogym export`` downloads: a CSV table, or NPZ arrays.

Shapes: n samples, C coordinates, F action entries.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from typing import Any

import numpy as np

from surrogym_server.storage.records import SampleRecord
from surrogym_shared.logs.writing import npz_of_steps, spreadsheet_cell

SOURCE = ("id", "purpose", "query_id", "sampler", "attempt", "late", "trajectory", "step")
PLAIN = (*SOURCE, "reward", "terminated", "truncated")
ARRAYS = ("id", "purpose", "coordinates", "action", "next_coordinates", "reward", "terminated", "truncated")


def samples_as_csv(coordinate_names: Sequence[str], records: Sequence[SampleRecord]) -> bytes:
    """Return samples as a CSV table with one row for each sample.

    Columns of coordinates are named ``q.<name>``, of next coordinates ``next.<name>``, of actions ``u.0``, ``u.1``, ...
    """
    text = io.StringIO()
    writer = csv.writer(text)
    actions = [f"u.{i}" for i in range(len(records[0].action))] if records else []
    q, q_next = [f"q.{name}" for name in coordinate_names], [f"next.{name}" for name in coordinate_names]
    writer.writerow(map(spreadsheet_cell, [*PLAIN, *q, *actions, *q_next]))
    for record in records:
        plain = [spreadsheet_cell(getattr(record, name)) for name in PLAIN]
        writer.writerow([*plain, *record.coordinates, *record.action, *record.next_coordinates])
    return text.getvalue().encode()


def samples_as_npz(coordinate_names: Sequence[str], records: Sequence[SampleRecord]) -> bytes:
    """Return samples as an NPZ archive: coordinates (n, C), action (n, F), next_coordinates (n, C), and one array (n,)
    for each other field, such as reward, terminated and purpose."""
    arrays: dict[str, Any] = {name: np.array([getattr(record, name) for record in records]) for name in ARRAYS}
    return npz_of_steps(coordinate_names, arrays)
