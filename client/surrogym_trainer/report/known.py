"""The data of a report: everything that a server knows about a surrogate and about one of its policies."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from surrogym_client.errors import NotInstalled, SurrogymClientError, UnknownPolicy
from surrogym_client.transport import Api
from surrogym_shared.checks import trace_fault
from surrogym_shared.spec import EnvironmentSpec
from surrogym_shared.wire import (
    Controller,
    EvaluationDetail,
    EvaluationView,
    ModelView,
    PolicyDetail,
    PolicyForm,
    PolicyView,
    SampleView,
    SurrogateView,
)
from surrogym_trainer.coverage import Cut, cuts
from surrogym_trainer.policies.controller_check import StoredCheck, UnusableCheck, read_check
from surrogym_trainer.policies.evidence import chosen_real

PREFERRED = "production"
VIDEOS: dict[PolicyForm, str] = {"mp4": "video/mp4", "gif": "image/gif"}
MOST_VIDEO_BYTES = 8 * 1024 * 1024  # largest size of a video that is embedded in a report


@dataclass(frozen=True)
class Known:
    """A surrogate, and a policy with its real episodes.

    Attributes:
        view: the surrogate.
        models: all fits, oldest first.
        samples: all real steps.
        server: the server's address and version.
        policy: the policy of the report; None if there is none.
        real: the policy's newest real episodes in the surrogate's own environment from the declared starts.
        without: real episodes without the policy, from the same starts.
        reference: real episodes of a reference controller, from the same starts.
        video: media type and content of the policy's video; None if there is none.
        others: the other versions of the surrogate's policies.
        check: check of the policy's deployed controller; None if there is none.
        missing: sentences about what could not be read.
        limits: how all real steps kept the limits of the specification, in sentences.
    """

    view: SurrogateView
    models: list[ModelView]
    samples: list[SampleView]
    server: str
    policy: PolicyDetail | None = None
    real: EvaluationDetail | None = None
    without: EvaluationDetail | None = None
    reference: EvaluationDetail | None = None
    video: tuple[str, bytes] | None = None
    others: tuple[PolicyView, ...] = ()
    check: StoredCheck | None = None
    missing: tuple[str, ...] = ()
    limits: tuple[str, ...] = ()


def collect(api: Api, name: str, which: str | None = None, controller: Path | None = None) -> Known:
    """Collect the data of a report. Its field ``missing`` has a sentence about each part that can't be read.

    Args:
        api: the connection to the server.
        name: name of the surrogate.
        which: version or alias of the policy. None takes the one in production, or else the newest.
        controller: folder of the policy's deployed controller, with its check.

    Raises:
        UnknownSurrogate, UnknownPolicy: there is none of this name.
        UnusableCheck: the folder has no check of this policy.
    """
    view, models, samples = api.surrogate(name), api.models(name), list(api.samples(name))
    server, limits = f"{api.url}, surrogym {api.health().version}", tuple(api.limits(name))
    policy, missing = _policy(api, name, which), list[str]()
    if policy is None:
        if controller is not None:
            raise UnusableCheck(
                f"expected a stored policy of surrogate {name!r} for the check in {controller}, got none: push it first"
            )
        return Known(view, models, samples, server, limits=limits)
    check = None
    if controller is not None:
        check = read_check(controller, next((file.digest for file in policy.files if file.form == "zip"), ""))
    real = chosen_real(policy)
    chosen = (real, chosen_without(policy, real), chosen_reference(policy, real))
    details: list[EvaluationDetail | None] = []
    for evaluation in chosen:
        detail = None if evaluation is None else api.policies.evaluation(name, policy.version, evaluation.id)
        if detail is not None and detail.missing:
            missing.append(f"the single episodes of evaluation {detail.id} are missing: {detail.missing}")
        details.append(detail and with_whole_traces(detail, view.spec, missing))
    video, lacks = _video(api, name, policy)
    missing += lacks
    others = tuple(one for one in api.policies.list(name) if one.version != policy.version)
    return Known(
        view,
        models,
        samples,
        server,
        policy,
        real=details[0],
        without=details[1],
        reference=details[2],
        video=video,
        others=others,
        check=check,
        missing=tuple(missing),
        limits=limits,
    )


def with_whole_traces(detail: EvaluationDetail, spec: EnvironmentSpec, missing: list[str]) -> EvaluationDetail:
    """Return an evaluation without the traces whose shape does not fit the specification, which earlier servers
    accepted. A sentence with their number is added to ``missing``."""
    whole = [
        trace
        for trace in detail.traces
        if not trace_fault(trace.coordinates, trace.action, trace.reward, c=len(spec.coordinates), f=spec.action.size)
    ]
    if beyond := len(detail.traces) - len(whole):
        missing.append(
            f"{beyond} traces of evaluation {detail.id} are left out: they have another shape than its steps"
        )
    return detail.model_copy(update={"traces": whole})


def _video(api: Api, name: str, policy: PolicyDetail) -> tuple[tuple[str, bytes] | None, list[str]]:
    """Return media type and content of a policy's video, or None, and a sentence about each video that could not be
    read."""
    missing = []
    for form, kind in VIDEOS.items():
        file = next((one for one in policy.files if one.form == form), None)
        if file is None:
            continue
        if not file.stored:
            missing.append(f"the video ({form}) is missing: it never came, or it was removed for newer files")
        elif file.bytes > MOST_VIDEO_BYTES:
            missing.append(
                f"the video has {file.bytes / 1e6:.0f} MB, too much for one page: surrogym policy get "
                f"{name}@{policy.version} --out video.{form}"
            )
        else:
            try:
                return (kind, api.policies.file(name, policy.version, form)), missing
            except SurrogymClientError as error:
                missing.append(f"the video ({form}) can't be read: {error}")
    return None, missing


def cuts_of(api: Api, known: Known) -> tuple[list[Cut], str]:
    """Return the latest model's maps over two coordinates, and an empty text; or no maps, and the reason."""
    try:
        return cuts(known.view, partial(api.query_uncertainty, known.view.name)), ""
    except NotInstalled as error:
        return [], str(error)


def chosen_without(policy: PolicyDetail, real: EvaluationView | None) -> EvaluationView | None:
    """Return the newest evaluation without the policy, in the same environment and from the same starts; None if there
    is none."""
    return _beside(policy, real, ("zero", "random"))


def chosen_reference(policy: PolicyDetail, real: EvaluationView | None) -> EvaluationView | None:
    """Return the newest evaluation of a reference controller, in the same environment and from the same starts; None if
    there is none."""
    return _beside(policy, real, ("reference",))


def _beside(
    policy: PolicyDetail, real: EvaluationView | None, controllers: Sequence[Controller]
) -> EvaluationView | None:
    if real is None or not real.seeded:
        return None
    starts = (real.own, real.first_seed, real.note)
    among = [one for one in policy.evaluations if one.controller in controllers and one.seeded]
    same = [one for one in among if (one.own, one.first_seed, one.note) == starts]
    return same[-1] if same else None


def _policy(api: Api, name: str, which: str | None) -> PolicyDetail | None:
    if which is not None:
        return api.policies.get(name, which)
    for wanted in (PREFERRED, "latest"):
        try:
            return api.policies.get(name, wanted)
        except UnknownPolicy:
            continue
    return None
