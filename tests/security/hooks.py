"""What schemathesis does not know of this service: a claim may wait for a query, and a test need not."""

from __future__ import annotations

from typing import Any

import schemathesis

WAIT_SECONDS = 0.05


@schemathesis.hook
def before_call(context: Any, case: Any, kwargs: Any) -> None:
    if case.operation.path.endswith(":claim") and isinstance(case.body, dict):
        wait = case.body.get("wait_seconds")
        if isinstance(wait, float | int) and not isinstance(wait, bool) and WAIT_SECONDS < wait <= 60:
            case.body["wait_seconds"] = WAIT_SECONDS
