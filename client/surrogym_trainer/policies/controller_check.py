"""The result of a check of a deployed controller, as a file in the controller's folder."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from surrogym_client.errors import SurrogymClientError
from surrogym_shared.faults import first_fault

FILE = "check.json"
MOST_BYTES = 64 * 1024


Count = Annotated[int, Field(ge=0, le=10**12)]


class UnusableCheck(SurrogymClientError):
    """The folder has no valid check of this policy's controller."""


class StoredCheck(BaseModel):
    """The result of a check: a deployed controller and its policy, run from the same starts and compared."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, strict=True)

    target: str
    environment: str = Field(description="original environment, or the virtual one of a surrogate")
    policy: str = Field(description="SHA-256 of the policy's file")
    episodes: Count
    steps: Count = Field(description="number of steps of the controller")
    largest_difference: float = Field(
        ge=0, description="largest difference of an action from the policy's, as a share of the action's range"
    )
    different_actions: Count = Field(
        description="steps whose action differs by more than 1e-6 of its range, 1e-4 in float"
    )
    faults: Count = Field(description="steps in which the controller took its fallback action")
    mean_return: float
    mean_return_of_policy: float
    microseconds: float | None = Field(
        ge=0, description="duration of one decision on the machine of the check; null if it was not measured"
    )


def write_check(folder: Path, check: StoredCheck) -> Path:
    """Write a check into the folder of its controller, and return the file's path."""
    path = folder / FILE
    path.write_text(check.model_dump_json(indent=2) + "\n", encoding="utf-8")
    return path


def read_check(folder: Path, policy: str) -> StoredCheck:
    """Read the check of a policy's controller.

    Args:
        folder: the controller's folder.
        policy: SHA-256 of the policy's file.

    Raises:
        UnusableCheck: the folder has no check, or that of another policy.
    """
    path = folder / FILE
    if not path.is_file():
        raise UnusableCheck(
            f"expected {path}, which surrogym deploy --check writes, got no such file: deploy the policy with "
            "--check first"
        )
    with path.open("rb") as file:
        content = file.read(MOST_BYTES + 1)
    if len(content) > MOST_BYTES:
        raise UnusableCheck(
            f"{path} is not the check of a controller: expected at most {MOST_BYTES} bytes, got more; run "
            "surrogym deploy --check"
        )
    try:
        check = StoredCheck.model_validate_json(content)
    except ValidationError as error:
        raise UnusableCheck(
            f"{path} is not the check of a controller: {first_fault(error)}; run surrogym deploy --check"
        ) from error
    if check.policy != policy:
        raise UnusableCheck(
            f"expected {path} to be a check of the report's policy, got one of another policy: run surrogym deploy "
            "--check"
        )
    return check
