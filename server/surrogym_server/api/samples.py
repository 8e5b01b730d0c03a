"""Routes of samples, as JSON, CSV table or NPZ arrays, of snapshots and of the counts of real steps."""

from __future__ import annotations

from typing import Annotated, Literal

from fastapi import APIRouter, Query
from fastapi.responses import Response

from surrogym_server.api import examples
from surrogym_server.api.door import READ, SAMPLE, TRAIN_OR_SAMPLE, DoorRoute, example, json_up_to
from surrogym_server.api.problems import documented
from surrogym_server.api.state import Use
from surrogym_server.convert import resources
from surrogym_server.convert.dirt import FIRST, dirt_of
from surrogym_server.convert.exports import samples_as_csv, samples_as_npz
from surrogym_server.convert.stored import read_stored
from surrogym_server.storage.records import LogPart
from surrogym_shared.codes import Code
from surrogym_shared.limits import KeptEpisodes
from surrogym_shared.spec import EnvironmentSpec
from surrogym_shared.wire import (
    AddedSamples,
    AddSamples,
    DirtList,
    DroppedSnapshots,
    DropSnapshots,
    Ledger,
    LimitsKept,
    ReportSteps,
    SamplePage,
    SnapshotList,
)

CSV = "text/csv"
NPZ = "application/x-npz"

router = APIRouter(prefix="/v1/surrogates/{name}", tags=["samples"], route_class=DoorRoute)

MAX_PAGE = 10_000


@router.post(
    "/add_sample",
    summary="Store samples",
    dependencies=[SAMPLE],
    openapi_extra=json_up_to(1_024),
    responses=documented(
        Code.UNKNOWN_SURROGATE,
        Code.UNKNOWN_QUERY,
        Code.FOREIGN_LEASE,
        Code.IDEMPOTENCY_CONFLICT,
        Code.INVALID_REQUEST,
    ),
)
def add_sample(name: str, body: Annotated[AddSamples, example(examples.ADD_SAMPLE)], use: Use) -> AddedSamples:
    """Store samples, all or none. They are committed when the reply comes. A repeat adds nothing: a sample that answers
    a query is identified by its lease token, a logged sample by its index in the log, others by the idempotency key."""
    samples = [resources.new_sample(sample) for sample in body.samples]
    log = LogPart(body.after, body.complete) if body.purpose == "logged" else None
    return resources.added_samples(use.samples.add(name, body.sampler, samples, body.idempotency_key, log))


@router.get(
    "/samples",
    summary="Read samples",
    response_model=SamplePage,
    dependencies=[READ],
    responses={
        200: {"content": {CSV: {}, NPZ: {}}},
        **documented(Code.UNKNOWN_SURROGATE, Code.INVALID_REQUEST),
    },
)
def samples(
    name: str,
    use: Use,
    after: Annotated[int, Query(ge=0)] = 0,
    limit: Annotated[int, Query(ge=1, le=MAX_PAGE)] = 1_000,
    format: Literal["json", "csv", "npz"] = "json",
) -> SamplePage | Response:
    """Read the samples of a surrogate. JSON comes in pages: give ``next_after`` as ``after`` for the next page. CSV and
    NPZ contain all samples."""
    if format == "json":
        return resources.sample_page(use.samples.page(name, after, limit), limit)
    write, media_type = (samples_as_csv, CSV) if format == "csv" else (samples_as_npz, NPZ)
    content = write(use.samples.coordinate_names(name), use.samples.all(name))
    return Response(content, media_type=media_type, headers=_attachment(f"{name}.{format}"))


@router.get(
    "/dirt",
    summary="Find dead time, encoders, friction and noise",
    dependencies=[READ],
    responses=documented(Code.UNKNOWN_SURROGATE, Code.INVALID_REQUEST),
)
def dirt(name: str, use: Use) -> DirtList:
    """Find dead time, encoders, friction that sticks and noise in the first 60 real steps of an original environment
    that can only be reset. Nothing is found before, or unless the evidence is clear."""
    record = use.storage.surrogates.get(name)
    return DirtList(findings=dirt_of(record.spec, record.tolerances, use.samples.page(name, 0, FIRST)))


@router.get(
    "/limits",
    summary="Count real steps beyond limits",
    dependencies=[READ],
    responses=documented(Code.UNKNOWN_SURROGATE, Code.INVALID_REQUEST),
)
def limits(name: str, use: Use) -> LimitsKept:
    """Count how many of all real steps ended beyond each limit of the specification, after how many the fallback was
    due, and how many episodes of evaluations left a limit."""
    record = use.storage.surrogates.get(name)
    spec = read_stored(EnvironmentSpec, "a stored specification", record.spec)
    if spec.limits is None:
        return LimitsKept(said=[])
    said = use.samples.kept(record, spec).words(spec)
    if counts := use.storage.ledger.limited(name):
        said.append(
            f"evaluations: {KeptEpisodes(**counts, probability=spec.limits.probability, least_room={}).words()}"
        )
    return LimitsKept(said=said)


@router.get(
    "/snapshots",
    summary="List snapshots",
    dependencies=[READ],
    responses=documented(Code.UNKNOWN_SURROGATE, Code.INVALID_REQUEST),
)
def snapshots(name: str, use: Use) -> SnapshotList:
    """List the snapshots (saved states to which a sampler can return), oldest first. ``add_sample`` adds snapshots."""
    return resources.snapshot_list(use.storage.snapshots.all(name))


@router.post(
    "/snapshots:drop",
    summary="Remove lost snapshots",
    dependencies=[SAMPLE],
    responses=documented(Code.UNKNOWN_SURROGATE, Code.INVALID_REQUEST),
)
def drop_snapshots(
    name: str, body: Annotated[DropSnapshots, example(examples.DROP_SNAPSHOTS)], use: Use
) -> DroppedSnapshots:
    """Remove snapshots that no sampler holds any more. Queries that begin at a removed snapshot are withdrawn, and the
    design chooses new ones."""
    return DroppedSnapshots(dropped=use.samples.drop_snapshots(name, body.snapshots))


@router.post(
    "/ledger",
    summary="Report real steps of an evaluation",
    dependencies=[TRAIN_OR_SAMPLE],
    responses=documented(Code.UNKNOWN_SURROGATE, Code.IDEMPOTENCY_CONFLICT, Code.INVALID_REQUEST),
)
def report(name: str, body: Annotated[ReportSteps, example(examples.LEDGER)], use: Use) -> Ledger:
    """Report real steps of an evaluation, which are counted separately from those of the design. Reports with the same
    idempotency key count once."""
    kept = None if body.limits is None else body.limits.model_dump()
    counts = use.storage.ledger.report(
        name, body.steps, key=body.idempotency_key, episodes=body.episodes, note=body.note, limits=kept
    )
    return resources.ledger(counts)


def _attachment(name: str) -> dict[str, str]:
    return {"content-disposition": f'attachment; filename="{name}"'}
