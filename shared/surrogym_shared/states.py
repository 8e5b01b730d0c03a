"""Types of the phases of a design, of the purposes of queries and samples, and of kinds and statuses."""

from typing import Literal, get_args

Phase = Literal["collecting", "fitting", "sampling", "ready", "over_budget", "unsure", "from_log", "failed"]
"""Phase of a design of queries."""

# Phases in which the design makes no further queries.
COMPLETED: tuple[Phase, ...] = ("ready", "over_budget", "unsure", "from_log")
ENDED: tuple[Phase, ...] = (*COMPLETED, "failed")  # phases in which a sampler has nothing left to do

Verdict = Literal["continue", "ready", "over_budget", "unsure", "from_log"]
"""Verdict of one round of a design. Unless it is ``continue``, the design ends, and the verdict is also its phase."""

Purpose = Literal["initial", "adaptive", "manual", "audit"]
"""Why a query was made."""

SamplePurpose = Literal["initial", "adaptive", "manual", "audit", "logged"]
"""Why the real step of a sample was taken: the purpose of its query, or ``logged``."""

# Purposes of real steps, by which the ledger counts them.
PURPOSES: tuple[str, ...] = (*get_args(SamplePurpose), "evaluation")
# All audits (tests of trained policies) of a surrogate may take this many real steps even if its budget is smaller:
# three audits of 40 steps.
LEAST_AUDITED = 128

QueryKind = Literal["step", "rollout"]
QueryStatus = Literal["pending", "leased", "answered", "set_aside", "refused"]
EventKind = Literal["created", "queries", "sample", "fit", "phase", "set_aside", "ledger", "damaged", "policy", "job"]

JobKind = Literal["train", "evaluate"]
JobStatus = Literal["queued", "running", "done", "failed", "cancelled"]
JobEnd = Literal["done", "failed", "cancelled"]
