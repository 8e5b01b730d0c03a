"""Results that are stored in a folder until the server has them. Sending a result twice has no effect."""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from surrogym_client.errors import LeaseExpired, SurrogymClientError
from surrogym_client.transport.api import Api
from surrogym_client.transport.connection import AWAY
from surrogym_shared import wire
from surrogym_shared.faults import first_fault
from surrogym_trainer.policies.card import UnusablePolicy
from surrogym_trainer.policies.pushing import push

ENDING = ".waiting.json"
REFUSED = ".refused.json"
MAX_BYTES = 64 * 1024 * 1024
FILE_NAME = r"^[A-Za-z0-9][A-Za-z0-9._-]{0,199}$"  # pattern of the name of a policy's file, without a folder
VIDEO_NAME = r"^[A-Za-z0-9][A-Za-z0-9._-]{0,195}\.(mp4|gif)$"


class Waiting(BaseModel):
    """The result of a job, as stored in a file until the server has it."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    surrogate: wire.SurrogateName
    job: int
    lease_token: wire.Key
    status: wire.JobEnd
    error: str | None = None
    # name of the trained policy's file, in the same folder as this result
    policy: Annotated[str, Field(pattern=FILE_NAME)] | None = None
    version: int | None = None  # version of the stored policy that was evaluated
    # name of the evaluation's video, in the same folder as this result
    video: Annotated[str, Field(pattern=VIDEO_NAME)] | None = None
    evaluations: tuple[wire.AddEvaluation, ...] = ()
    steps: tuple[wire.ReportSteps, ...] = ()  # real steps to be counted in the ledger


class Outbox:
    """Results in a folder, each in a file of its own.

    Args:
        folder: holds policies and waiting results; several workers may share it.
        tell: called with a sentence about each result.
    """

    def __init__(self, folder: Path, tell: Callable[[str], None]) -> None:
        self._folder = folder
        self._tell = tell

    def put(self, waiting: Waiting) -> None:
        """Write a result to the folder, before it is sent for the first time."""
        self._folder.mkdir(parents=True, exist_ok=True)
        name = re.sub(r"[^A-Za-z0-9._-]", "-", f"{waiting.surrogate}-job{waiting.job}-{waiting.lease_token[:8]}")
        path = self._folder / f"{name}{ENDING}"
        part = path.with_suffix(".part")
        part.write_text(waiting.model_dump_json(), encoding="utf-8")
        os.replace(part, path)

    def send(self, api: Api) -> None:
        """Send all results. Those that the server refuses are renamed, and reported with the reason.

        Raises:
            ServerUnreachable, Unavailable: the server can't be reached; what was not sent stays in the folder.
        """
        for path in sorted(self._folder.glob(f"*{ENDING}")):
            try:
                waiting = _read(path)
            except FileNotFoundError:
                continue  # another worker has sent this result
            except UnusablePolicy as error:
                self._set_aside(path, error)
                continue
            try:
                self._tell(self._sent(api, waiting))
                path.unlink(missing_ok=True)
            except AWAY:
                raise
            except SurrogymClientError as error:
                self._set_aside(path, error)

    def _set_aside(self, path: Path, error: Exception) -> None:
        aside = path.with_name(path.name.removesuffix(ENDING) + REFUSED)
        with suppress(FileNotFoundError):
            os.replace(path, aside)
        self._tell(f"the server does not take the result in {aside}: {error}")

    def _sent(self, api: Api, waiting: Waiting) -> str:
        """Send one result to the server, and return a sentence about how its job ended there."""
        name, status = waiting.surrogate, waiting.status
        for steps in waiting.steps:
            key = steps.idempotency_key
            api.report_steps(name, steps.steps, episodes=steps.episodes, note=steps.note, idempotency_key=key)
        version, number, error = waiting.version, None, waiting.error
        try:
            if waiting.policy is not None:
                version = push(api, self._folder / waiting.policy, name).policy.version
            number = _evaluated(api, name, version, waiting.evaluations)
            self._send_video(api, waiting)
        except AWAY:
            raise
        # the job has to end on the server even if its result is refused
        except (SurrogymClientError, OSError) as refused:
            error = in_one_line("; ".join([*([error] if error else []), f"the result was not stored: {refused}"]))
            status = "failed" if status == "done" else status
        try:
            api.jobs.finish(
                name, waiting.job, waiting.lease_token, status, error=error, version=version, evaluation=number
            )
        except LeaseExpired:
            return f"job {waiting.job}: the server gave it to another worker meanwhile{_stored(name, version)}"
        return f"job {waiting.job} {status}{f': {error}' if error else ''}{_stored(name, version)}"

    def _send_video(self, api: Api, waiting: Waiting) -> None:
        """Send the video of an evaluation. It replaces an older video of the same format."""
        if waiting.video is not None and waiting.version is not None:
            path = self._folder / waiting.video
            form: wire.PolicyForm = "mp4" if path.suffix == ".mp4" else "gif"
            api.policies.put_file(waiting.surrogate, waiting.version, form, path.read_bytes())


def _evaluated(api: Api, name: str, version: int | None, evaluations: tuple[wire.AddEvaluation, ...]) -> int | None:
    """Send the evaluations of a policy and of the controllers that it is compared with. Return the id of the policy's
    evaluation; None if there is none."""
    stored = [api.policies.evaluate(name, version or 0, evaluation) for evaluation in evaluations]
    return next((one.id for one in stored if one.controller == "policy"), None)


def _stored(name: str, version: int | None) -> str:
    return "" if version is None else f"; see {name}@{version}"


def in_one_line(text: str) -> str:
    """Return a text in the form that the server accepts: one line of visible characters, not too long."""
    return " ".join(re.sub(r"[\x00-\x1f\x7f-\x9f\u2028-\u202e\u2066-\u2069]", " ", text).split())[:2_000]


def _read(path: Path) -> Waiting:
    with path.open("rb") as file:
        content = file.read(MAX_BYTES + 1)
    try:
        if len(content) > MAX_BYTES:
            raise UnusablePolicy(
                f"the result of a job in {path} has more than {MAX_BYTES} bytes: train smaller networks"
            )
        return Waiting.model_validate_json(content)
    except ValidationError as error:
        raise UnusablePolicy(f"{path} is not the result of a job: {first_fault(error)}; delete the file") from error
