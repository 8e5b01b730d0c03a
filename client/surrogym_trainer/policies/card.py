"""The card beside a policy's file: what the policy was trained for, with which settings and results."""

from __future__ import annotations

import json
import re
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, Field, RootModel, ValidationError

from surrogym_client.errors import SurrogymClientError
from surrogym_shared.faults import first_fault
from surrogym_shared.patterns import NAME, POLICY
from surrogym_shared.spec import EnvironmentSpec
from surrogym_shared.wire import CurvePoint, SurrogateName
from surrogym_trainer.policies.evidence import Audit, Promise

DEFAULT_ALGORITHM = "PPO"
MAX_CARD_BYTES = 1024 * 1024


class UnusablePolicy(SurrogymClientError):
    """The file is not a policy of the algorithm, or its card is invalid."""


class NotedAddress(RootModel[str]):
    """The address of a server, as read from a file.

    It is not a ``str``, so that no code connects to it by mistake: only a person chooses the address that receives a
    token.
    """

    model_config = ConfigDict(frozen=True)

    def __str__(self) -> str:
        return self.root


class PolicyCard(BaseModel):
    """The card of a policy: what it was trained for, its settings and its results.

    It is stored beside the policy in a JSON file of the same name.
    """

    model_config = ConfigDict(extra="ignore", frozen=True)  # newer versions may write further fields

    algorithm: str = DEFAULT_ALGORITHM
    surrogate: SurrogateName | None = None
    server: NotedAddress | None = None
    spec: EnvironmentSpec | None = None
    seed: int | None = None
    virtual_steps: int | None = None
    model: str = ""  # hash of the samples from which the model learned that predicts the promised return
    seconds: float | None = None
    imagined_return: float | None = None
    visited_confidence: tuple[float | None, ...] = ()
    untrained: float | None = None  # imagined return of an untrained network
    promise: Promise | None = None
    audit: Audit | None = None
    trusted: bool | None = None  # whether the promised interval of the return is supported; None if it was not judged
    reason: str = ""  # sentence about why the promised interval of the return is trusted or not
    curve: tuple[CurvePoint, ...] = ()  # points of the training curve: virtual steps and imagined return
    networks: int = 1  # number of networks that the last training began; above 1 if some learned nothing
    settings: dict[str, Any] = Field(default_factory=dict)
    versions: dict[str, str] = Field(default_factory=dict)

    @property
    def set_points(self) -> dict[str, float]:
        """Set points that replace those of the specification's reward, by coordinate; empty if there are none."""
        return set_points_in(self.settings)

    @property
    def integral(self) -> tuple[str, ...]:
        """Coordinates whose errors the policy also sees, summed over the episode; empty if there are none."""
        return tuple(self.settings.get("integral") or ())

    @property
    def limits(self) -> tuple[str, ...]:
        """Limits that a planner keeps besides those of the specification, such as ``level<=11``."""
        return limits_in(self.settings)


def set_points_in(settings: Mapping[str, Any]) -> dict[str, float]:
    """Return the set points, by coordinate, in the settings of a training, as a card and the server have them."""
    session = settings.get("session")
    return dict(session.get("set_points") or {}) if isinstance(session, dict) else {}


def limits_in(settings: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the limits that a planner got at run time, from the settings of a training."""
    limits = settings.get("limits")
    return tuple(map(str, limits)) if isinstance(limits, list | tuple) else ()


def words_of_set_points(points: Mapping[str, float]) -> str:
    """Return set points in words, such as ``level = 12``; empty if there are none."""
    return ", ".join(f"{name} = {value:g}" for name, value in points.items())


def missing_policy(policy: Path) -> FileNotFoundError:
    """Return the error for a policy file that does not exist. If its name is that of a policy on a server, such as
    ``pendulum@3``, the message has the command that downloads this policy."""
    name, _, which = str(policy).partition("@")
    stored = re.match(NAME, name) and re.match(POLICY, which)
    get = f"; to download it from the server: surrogym policy get {policy} --out policy.zip" if stored else ""
    return FileNotFoundError(2, f"no such policy file{get}", str(policy))


def card_path(policy: Path) -> Path:
    """Return the path of a policy's card."""
    return policy.with_suffix(".json")


def require_place(policy: Path) -> None:
    """Raise an error if a policy can't be written to a file, or if its card would replace another kind of file, such as
    a specification.

    Raises:
        UnusablePolicy: the file is a folder, no file can be created where it is to be, or a JSON file with the card's
            name exists and is not a card.
    """
    if policy.is_dir():
        raise UnusablePolicy(f"expected a file for the policy, got the folder {policy}: add a file name")
    folder = next(place for place in policy.absolute().parents if place.exists())
    try:
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        raise UnusablePolicy(
            f"expected a place where the policy can be written, got {policy}: no file can be created in {folder} "
            f"({error.strerror}): choose another file"
        ) from error
    path = card_path(policy)
    if not path.exists():
        return
    try:
        known = path.stat().st_size <= MAX_CARD_BYTES and "virtual_steps" in json.loads(path.read_bytes())
    except (ValueError, TypeError, RecursionError):
        known = False
    if not known:
        raise UnusablePolicy(
            f"the card of {policy} would replace {path}, which is not a card: choose another name for the policy"
        )


def write_card(policy: Path, card: PolicyCard) -> None:
    """Write the card of a policy to the JSON file beside it."""
    card_path(policy).write_text(card.model_dump_json(indent=2) + "\n", encoding="utf-8")


def read_card(policy: Path) -> PolicyCard:
    """Read the card of a policy; the result is an empty card if there is none.

    Raises:
        UnusablePolicy: the card is invalid, or has more than ``MAX_CARD_BYTES``.
        FileNotFoundError: there is no such policy.
    """
    if not policy.is_file():
        raise missing_policy(policy)
    if not card_path(policy).exists():
        return PolicyCard()
    with card_path(policy).open("rb") as file:
        content = file.read(MAX_CARD_BYTES + 1)
    if len(content) > MAX_CARD_BYTES:
        raise UnusablePolicy(
            f"{card_path(policy)} is not the card of a policy: expected at most {MAX_CARD_BYTES} bytes, got more; "
            "download it again"
        )
    try:
        return PolicyCard.model_validate_json(content)
    except ValidationError as error:
        raise UnusablePolicy(
            f"{card_path(policy)} is not the card of a policy: {first_fault(error)}; download or train the policy again"
        ) from error
