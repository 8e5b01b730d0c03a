"""What a demo tells, without running one."""

from __future__ import annotations

from typing import Any

METRICS: dict[str, Any] = {
    "task": "pendulum",
    "arm": "default",
    "seed": 3,
    "budget": 14,
    "real_queries": {"initial": 4, "adaptive": 5, "total": 9, "unresolved": 0, "audit": 8},
    "real_return": {"mean": -150.0, "iqm": -140.0, "min": -400.0, "max": -1.0, "std": 60.0, "episodes": 100},
    "success_rate": 0.93,
    "also": {"mean": -200.0, "iqm": -190.0, "min": -900.0, "max": -1.0, "episodes": 100, "success_rate": 0.9},
    "without": {"mean": -1200.0, "iqm": -1190.0, "min": -1500.0, "max": -900.0, "episodes": 20, "actions": "random"},
    "reached": False,
    "imagined_return": -145.0,
    "promise": {"median": -144.0, "low": -160.0, "high": -130.0},
    "varied": [],
    "trusted": True,
    "virtual_steps": 300,
    "phase": "ready",
    "confidence_index": 1.0,
    "seconds": {"design": 1.0, "total": 50.0},
    "commit": "abc",
    "specification": "s",
    "configuration": "c",
    "machine": "m",
}
