"""Pydantic models of the requests and replies of every HTTP route, in JSON. Unknown fields are refused; numbers must be
finite.

Shapes: N lanes, D observation entries, C coordinates, F action entries, O model outputs (moving coordinates, reward).

Each module here is imported when one of its names is first used, so that a client which only steps loads little.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from surrogym_shared.lazy import on_first_use

if TYPE_CHECKING:
    from surrogym_shared.wire.base import *  # noqa: F403
    from surrogym_shared.wire.jobs import *  # noqa: F403
    from surrogym_shared.wire.logs import *  # noqa: F403
    from surrogym_shared.wire.models import *  # noqa: F403
    from surrogym_shared.wire.policies import *  # noqa: F403
    from surrogym_shared.wire.queries import *  # noqa: F403
    from surrogym_shared.wire.service import *  # noqa: F403
    from surrogym_shared.wire.sessions import *  # noqa: F403
    from surrogym_shared.wire.surrogates import *  # noqa: F403

_NAMES = {
    "base": (
        "MAX_BATCH MAX_CLAIM MAX_DRAWS MAX_IMAGINED MAX_LANES MAX_MEASURED MAX_PARTICLES MAX_ROLLOUT PROTOCOL "
        "AutoresetMode Key Matrix Measured Phase Purpose QueryKind QueryStatus Reply Request Role SamplePurpose Seed "
        "Seq SurrogateName Variant Vector"
    ),
    "jobs": (
        "JOB_LEASE_SECONDS MAX_JOB_EPISODES MAX_JOB_POINTS MAX_JOB_STEPS AddJob ClaimedJob ClaimJob EvaluateTask "
        "FinishJob JobAlgorithm JobDetail JobEnd JobList JobPoint JobPreset JobStage JobState JobStatus JobView "
        "LeasedJob ReportedJob ReportJob Task TrainTask WorkerView"
    ),
    "logs": "MAX_LOG MAX_REJECTED AddedLog AddLog DraftedLog DraftLog LogReport RejectedRow",
    "models": "Imagine Imagined ImaginedEpisode ModelList ModelView Points Prediction Uncertainty",
    "policies": (
        "FEWEST_TO_JUDGE MAX_CURVE MAX_EPISODES MAX_TRACE MAX_TRACES AddEvaluation AddPolicy AliasName Controller "
        "CurvePoint EpisodeTrace EvaluationDetail EvaluationView FileNotice Interval PolicyAudit PolicyDetail "
        "PolicyFileView PolicyForm PolicyList PolicyPromise PolicyRangeLeft PolicyView PushedCard PushedPolicy "
        "PutAlias TraceRank"
    ),
    "queries": (
        "QUERY_LEASE_SECONDS AddedSamples AddQueries AddSamples AuditModel ClaimedQueries ClaimQueries DirtFinding "
        "DirtList DroppedSnapshots DropSnapshots FailQuery Improve LeasedQuery LimitCounts LimitsKept NewSample "
        "Query QueryList QueryView RenewLease ReportSteps RolloutQuery SamplePage SampleView SnapshotList "
        "SnapshotView StepQuery Trial WithdrawnQueries WithdrawQueries"
    ),
    "service": "Access Event Health Ready",
    "sessions": (
        "OF_PARTICLES ActionNoise ActionRow Actions ActionSpace BoxSpace DiscreteSpace MultiDiscreteSpace "
        "OpenSession PolicyArrays PolicyLayer Residual ResetReply ResetSession RolloutReply RolloutSession "
        "SessionActivity SessionCoordinates SessionList SessionView StepReply StepSession SubmitOccupancy "
        "SubmittedOccupancy"
    ),
    "surrogates": (
        "CheckedSurrogate CreatedSurrogate CreateSurrogate DoubtfulRegion Fidelity ImprovedSurrogate Ledger "
        "OutputFidelity PatchSurrogate QueryCounts ReachedLimit SurrogateList SurrogateSummary "
        "SurrogateView"
    ),
}

__getattr__, __all__ = on_first_use(__name__, _NAMES)
