"""Files of planners: a surrogate's model and a horizon, from which the actions are planned when they are needed."""

from __future__ import annotations

import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import BaseModel, Field, FiniteFloat, ValidationError

from surrogym_client.environments.file_factories import planner_of
from surrogym_shared.archives import has_entry, read_entries
from surrogym_shared.faults import first_fault
from surrogym_shared.spec.base import MAX_INEQUALITIES
from surrogym_shared.surrogate_file import MAX_FILE_BYTES, PLANNER_HEAD
from surrogym_trainer.policies.card import UnusablePolicy
from surrogym_trainer.policies.predict import Predict

MODEL = "model.surrogate"


class _Head(BaseModel):
    """JSON header in the file of a planner."""

    version: Literal[1, 2]  # 2 if there are limits, which a reader of version 1 would not keep
    horizon: int
    seed: int
    set_points: dict[str, float] = Field(default_factory=dict)
    limits: tuple[str, ...] = Field(default=(), max_length=MAX_INEQUALITIES)
    sensor_noise: dict[str, Annotated[FiniteFloat, Field(ge=0)]] = Field(default_factory=dict)


@dataclass(frozen=True)
class PlannerFile:
    """A planner as it is saved."""

    surrogate: bytes  # specification and model, as the content of a surrogate's file
    horizon: int  # number of steps of each planned rollout
    seed: int  # seed of the changes of actions that the planner tries
    set_points: Mapping[str, float] = field(default_factory=dict)  # other set points of the reward, by coordinate
    limits: tuple[str, ...] = ()  # limits that the plans keep, as ``surrogym_shared.limits.limit_of`` reads them
    # standard deviations of measurements, by coordinate, from which the planner filters the state
    sensor_noise: Mapping[str, float] = field(default_factory=dict)

    def save(self, path: Path) -> None:
        """Write the planner to a zip file, which contains no code."""
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
            head = _Head(
                version=2 if self.limits else 1,
                horizon=self.horizon,
                seed=self.seed,
                set_points=dict(self.set_points),
                limits=self.limits,
                sensor_noise=dict(self.sensor_noise),
            )
            file.writestr(PLANNER_HEAD, head.model_dump_json())
            file.writestr(MODEL, self.surrogate)

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read a file that ``save`` wrote. Raises ``UnusablePolicy`` if it is damaged."""
        try:
            entries = read_entries(path, MAX_FILE_BYTES)
            head = _Head.model_validate_json(entries[PLANNER_HEAD])
            return cls(entries[MODEL], head.horizon, head.seed, head.set_points, head.limits, head.sensor_noise)
        except ValidationError as error:
            raise UnusablePolicy(f"{path} is not a planner: {first_fault(error)}; train it again") from error
        except (KeyError, ValueError) as error:
            raise UnusablePolicy(f"{path} is not a planner: {error}; train it again") from error

    @staticmethod
    def is_at(path: Path) -> bool:
        """Whether a file is a zip file with the header that ``save`` writes."""
        return has_entry(path, PLANNER_HEAD)

    def acting(self) -> Predict:
        """Return the planner as a function from observations to actions. This computes its values, in some seconds.

        Raises:
            UnusablePolicy: the extra ``server`` is missing, or the model does not allow planning; with the reason.
        """
        try:
            given = (self.set_points, self.limits, self.sensor_noise)
            return planner_of(self.surrogate, self.horizon, self.seed, *given)
        except Exception as error:  # errors of the server's package, whose classes the client does not import
            raise UnusablePolicy(str(error)) from error
