"""Upload of a policy and its evaluations to the server. Evaluations that can't be sent are stored beside the policy's
file."""

from __future__ import annotations

import contextlib
import hashlib
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import cast, get_args

from pydantic import TypeAdapter, ValidationError

from surrogym_client.errors import InvalidInput
from surrogym_client.transport import Api
from surrogym_shared import wire
from surrogym_shared.faults import first_fault
from surrogym_trainer.policies.card import PolicyCard, UnusablePolicy, read_card

MAX_WAITING_BYTES = 64 * 1024 * 1024
MAX_VIDEO_BYTES = 32 * 1024 * 1024  # largest size of a video that the server stores
VIDEOS: tuple[wire.PolicyForm, ...] = ("mp4", "gif")
CURVE_POINTS = 200
_WAITING = TypeAdapter(list[wire.AddEvaluation])


@dataclass(frozen=True)
class Pushed:
    """A policy that the server has stored, and the number of evaluations sent with it."""

    surrogate: str
    policy: wire.PushedPolicy
    evaluations: int
    refused: str = ""  # why the server refused the video; empty if it did not


def thinned(curve: Sequence[wire.CurvePoint]) -> tuple[wire.CurvePoint, ...]:
    """Return at most ``CURVE_POINTS`` evenly chosen points of a curve, including the last."""
    every = max(1, -(-len(curve) // CURVE_POINTS))
    return tuple(curve[(len(curve) - 1) % every :: every]) if curve else ()


def keep(policy: Path, evaluation: wire.AddEvaluation) -> None:
    """Add an evaluation to the file beside the policy from which ``push`` will send it."""
    _write(policy, [*_read(policy), evaluation])


def waiting_path(policy: Path) -> Path:
    """Return the path of the file with the evaluations that have not been sent to the server yet."""
    return policy.with_suffix(".evaluations.json")


def push(api: Api, policy: Path, surrogate: str | None = None) -> Pushed:
    """Send a policy's file and card, and the evaluations and the video beside it. Repeating the call changes nothing.

    Args:
        api: the connection to the server.
        policy: the policy's file.
        surrogate: surrogate that the policy belongs to; None takes the card's.

    Raises:
        UnusablePolicy: no surrogate is known, the file has an unknown form, or the server does not accept the card.
        SpecConflict: the policy was made for other observations or actions than the surrogate's.
        SurrogymClientError: the server can't be reached, or refuses the request; the files beside the policy stay.
    """
    card, form = read_card(policy), _form(policy)
    name = surrogate or card.surrogate
    if name is None:
        raise UnusablePolicy(
            f"expected the name of a surrogate, because no card beside {policy} names one: give --surrogate NAME"
        )
    try:
        card_sent, curve = as_pushed(card), thinned(card.curve)
    except ValidationError as error:
        raise UnusablePolicy(
            f"the card beside {policy} can't be stored: {first_fault(error)}; correct the card"
        ) from error
    sent = api.policies.push(name, card_sent, curve, form, policy.read_bytes())
    waiting = _read(policy)
    for evaluation in waiting:
        api.policies.evaluate(name, sent.version, evaluation)
        _write(policy, [one for one in _read(policy) if one.idempotency_key != evaluation.idempotency_key])
    return Pushed(name, sent, len(waiting), _push_video(api, name, sent, policy))


def _push_video(api: Api, name: str, sent: wire.PushedPolicy, policy: Path) -> str:
    """Send the video beside a policy, unless the server has it. Returns why the server refused the video; empty if it
    did not."""
    for form in VIDEOS:
        path = policy.with_suffix(f".{form}")
        if not path.is_file():
            continue
        if path.stat().st_size > MAX_VIDEO_BYTES:
            return f"{path} has more than {MAX_VIDEO_BYTES // 2**20} MiB"
        content = path.read_bytes()
        digest = hashlib.sha256(content).hexdigest()
        if any(one.stored and one.digest == digest for one in sent.files):
            continue
        try:
            api.policies.put_file(name, sent.version, form, content)
        except InvalidInput as error:
            return f"{path}: {error}"
    return ""


def as_pushed(card: PolicyCard) -> wire.PushedCard:
    """Return a card in the form that is sent, without the server's address, which is private."""
    return wire.PushedCard.model_validate(card.model_dump(mode="json", exclude={"server", "curve"}))


def _form(policy: Path) -> wire.PolicyForm:
    form, known = policy.suffix.lower().removeprefix("."), get_args(wire.PolicyForm)
    if form not in known:
        raise UnusablePolicy(f"expected a file ending in {', '.join(known)}, got {policy.name}")
    return cast(wire.PolicyForm, form)


def _read(policy: Path) -> list[wire.AddEvaluation]:
    path = waiting_path(policy)
    if not path.exists():
        return []
    with path.open("rb") as file:
        content = file.read(MAX_WAITING_BYTES + 1)
    try:
        if len(content) > MAX_WAITING_BYTES:
            raise ValueError(f"expected a file of at most {MAX_WAITING_BYTES} bytes, got a larger one")
        return _WAITING.validate_json(content)
    except (ValidationError, ValueError) as error:
        said = first_fault(error) if isinstance(error, ValidationError) else str(error)
        raise UnusablePolicy(f"{path} is not a list of evaluations: {said}; move the file away") from error


def _write(policy: Path, evaluations: Sequence[wire.AddEvaluation]) -> None:
    path = waiting_path(policy)
    if not evaluations:
        with contextlib.suppress(FileNotFoundError):
            path.unlink()
        return
    part = path.with_suffix(".part")
    part.write_bytes(_WAITING.dump_json([*evaluations]))
    os.replace(part, path)
