"""The table of a demo counts apart what was learned from and what was only measured."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from surrogym.demo.report import table

METRICS: dict[str, Any] = {
    "task": "cartpole",
    "arm": "default",
    "seed": 3,
    "environment": "CartPole-v1",
    "real_queries": {"initial": 4, "adaptive": 2, "total": 6, "unresolved": 0, "audit": 8},
    "description_steps": 0,
    "evaluation_steps": 44_000,
    "confidence_index": 1.0,
    "phase": "ready",
    "virtual_steps": 1024,
    "seconds": {"design": 1.0, "train": 2.0, "evaluate": 0.5, "total": 4.0},
    "real_return": {"mean": 500.0, "iqm": 500.0, "min": 500.0, "max": 500.0, "episodes": 100},
    "imagined_return": 500.0,
    "promise": {"low": 490.0, "median": 495.0, "high": 500.0},
    "audit": {"steps": 8},
    "varied": [],
    "trusted": True,
    "reason": "all agree",
    "success_rate": 1.0,
    "also": None,
    "without": {"mean": 9.0, "episodes": 20, "actions": "random"},
    "target": "all 500",
    "reached": True,
}


def rows(**changed: Any) -> dict[str, str]:
    lines = table(METRICS | changed, Path("run")).splitlines()
    return dict(line.strip().split("  ", 1) for line in lines)


@pytest.mark.parametrize(
    ("changed", "expected"),
    [
        ({}, "6 + 8 for the audit (4 initial, 2 adaptive)"),
        ({"description_steps": 412}, "6 + 412 for the description + 8 for the audit (4 initial, 2 adaptive)"),
        (
            {"audit": None, "real_queries": {"initial": 4, "adaptive": 2, "total": 6, "unresolved": 0}},
            "6 (4 initial, 2 adaptive)",
        ),
    ],
)
def test_the_demo_table_lists_real_steps_by_their_purpose(changed, expected):
    assert rows(**changed)["real steps"].strip() == expected


def test_the_demo_table_counts_evaluation_steps_separately_at_its_end():
    shown = rows()
    names = list(shown)
    assert names.index("evaluation") == names.index("target") + 1
    assert shown["evaluation"].strip().startswith("44000 real steps")
    assert [name for name, value in shown.items() if "44000" in value] == ["evaluation"]
