"""Surrogates' files made from a few steps of formulas, and FMUs stepped by fmpy."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from fmpy import extract, read_model_description
from fmpy.fmi3 import FMU3Slave

from support.models import learn
from surrogym_server.convert import definition_from_spec
from surrogym_server.environment.samples import Samples
from surrogym_server.models.files import to_bytes
from surrogym_shared.spec import (
    Bounds,
    BoxAction,
    Coordinate,
    DeclaredReward,
    EnvironmentSpec,
    ObservationEntry,
    Quantity,
    RewardTerm,
    Term,
    Uniform,
)
from surrogym_shared.surrogate_file import RealSamples, SurrogateFile

HEIGHT, PERIOD = 1.0, 10.0


def tanks() -> EnvironmentSpec:
    """The two tanks of examples/fmus."""
    full = Uniform(low=0, high=HEIGHT)
    off = Quantity(term=Term.linear(lower=1) + Term.constant(-0.4))
    return EnvironmentSpec(
        coordinates=tuple(
            Coordinate(name=name, unit="m", sampling=full, bounds=Bounds(low=0, high=HEIGHT))
            for name in ("upper", "lower")
        ),
        observation=tuple(ObservationEntry(name=name, term=Term.linear(**{name: 1})) for name in ("upper", "lower")),
        action=BoxAction(low=(0,), high=(1,)),
        start={"upper": Uniform(low=0.05, high=0.6), "lower": Uniform(low=0.05, high=0.6)},
        reward=DeclaredReward(
            kind="declared", timing="after", terms=(RewardTerm(shape="square", weight=-1, of=(off,)),)
        ),
        time_limit=100,
        sampling_period=PERIOD,
    )


def drained(count: int) -> Samples:
    """Steps of the tanks."""
    p = torch.rand(count, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    q, u, after = p[:, :2], p[:, 2:], p[:, :2].clone()
    for _ in range(20):
        out = 5e-5 / 0.0154 * (2 * 9.81 * after.clamp_min(0)).sqrt()
        into = torch.cat([2.8e-4 / 0.0154 * u, out[:, :1]], 1)
        after = (after + PERIOD / 20 * (into - out)).clamp(0, HEIGHT)
    return Samples(q, u, after, -((after[:, 1] - 0.4) ** 2), torch.zeros(count, dtype=torch.bool))


def exported(name: str, spec: EnvironmentSpec, samples: Samples) -> SurrogateFile:
    """The file of a surrogate that learned from these steps."""
    model = to_bytes(learn(definition_from_spec(spec), samples).model)
    q, u, q_next, reward, over = (getattr(samples, n).numpy() for n in ("q", "u", "q_next", "reward", "terminated"))
    return SurrogateFile(name, spec, model, RealSamples(q, u, q_next, reward, over, np.zeros_like(over)))


class OpenFmu:
    """One instance of an FMU that fmpy loaded. Values are set and read by the names of variables."""

    def __init__(self, path: Path, log: Callable[[str], object]) -> None:
        self.described = read_model_description(str(path))
        self.folder = extract(str(path))
        self.references = {v.name: v.valueReference for v in self.described.modelVariables}
        self._types = {v.name: v.type for v in self.described.modelVariables}
        self.fmu: Any = FMU3Slave(
            guid=self.described.guid,
            unzipDirectory=self.folder,
            modelIdentifier=self.described.coSimulation.modelIdentifier,
            instanceName="one",
        )
        self.fmu.instantiate(loggingOn=True, logMessage=_logging(log))

    def begin(self, start: Mapping[str, float] | None = None) -> None:
        for name, value in (start or {}).items():
            self.set(name, value)
        self.fmu.enterInitializationMode()
        self.fmu.exitInitializationMode()

    def set(self, name: str, value: float) -> None:
        getattr(self.fmu, f"set{self._types[name]}")([self.references[name]], [value])

    def get(self, *names: str) -> list[float]:
        return [float(getattr(self.fmu, f"get{self._types[n]}")([self.references[n]])[0]) for n in names]

    def step(self, now: float, seconds: float, **inputs: float) -> None:
        for name, value in inputs.items():
            self.set(name, value)
        self.fmu.doStep(currentCommunicationPoint=now, communicationStepSize=seconds)


@contextmanager
def opened(path: Path, said: list[str] | None = None) -> Iterator[OpenFmu]:
    """An instance, not yet initialised; ``said`` gets what it reports."""
    one = OpenFmu(path, [].append if said is None else said.append)
    try:
        yield one
    finally:
        one.fmu.freeInstance()
        shutil.rmtree(one.folder, ignore_errors=True)


def _logging(log: Callable[[str], object]) -> Callable[..., None]:
    def said(_environment: object, _status: int, _category: bytes, message: bytes) -> None:
        log(message.decode())

    return said
