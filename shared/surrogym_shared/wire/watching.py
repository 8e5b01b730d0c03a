"""Wire models of streams: real steps that a machine posts, to be compared with the model but not learned."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from surrogym_shared.patterns import VISIBLE
from surrogym_shared.wire.base import Key, Measured, Reply, Request, Vector

MAX_STEPS = 500  # largest number of steps in a request
Number = Annotated[int, Field(ge=0, lt=2**53)]


class MachineStep(Request):
    """One real step of the machine."""

    coordinates: Vector = Field(description="(C,) state before the step")
    action: Vector = Field(description="(F,) action that was applied")
    next_coordinates: Vector = Field(description="(C,) state after the step")
    reward: Measured = Field(description="reward of the step")
    terminated: bool = Field(default=False, description="whether the step ended the episode in a terminal state")


class AddSteps(Request):
    """Request to append real steps to a stream, all or none."""

    machine: Annotated[str, Field(max_length=256, pattern=VISIBLE)] = Field(
        description="name of the environment that the steps are of: that of the surrogate's specification"
    )
    stream: Key = Field(description="name of the stream; after lost steps or a restart, begin another one")
    first: Number = Field(description="number of the first of these steps in the stream, which begins with 0")
    period: Annotated[float, Field(gt=0, allow_inf_nan=False)] | None = Field(
        default=None, description="seconds between two steps, compared with the specification's; null: not known"
    )
    steps: Annotated[list[MachineStep], Field(min_length=1, max_length=MAX_STEPS)] = Field(
        description="the steps, oldest first, without gaps"
    )


class AddedSteps(Reply):
    """Reply after the steps were stored durably."""

    stored: int = Field(description="number of steps that were not stored before")
    next: int = Field(description="number of the step with which the stream has to continue")


class StreamedStep(MachineStep):
    """A stored step of a stream."""

    id: int = Field(description="id of the step; later steps of a surrogate have larger ids")
    stream: str = Field(description="name of the stream")
    number: int = Field(description="number of the step in its stream")


class StepPage(Reply):
    """One page of the steps of a surrogate's streams."""

    steps: list[StreamedStep] = Field(description="steps of this page, oldest first")
