"""The dirt of a machine in the first stored samples, in the words of ``surrogym doctor --history``."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from functools import lru_cache
from itertools import groupby
from typing import Any

import numpy as np

from surrogym_server.convert.stored import read_stored
from surrogym_server.storage.records import SampleRecord
from surrogym_shared.spec import EnvironmentSpec
from surrogym_shared.wire import DirtFinding

FIRST = 1_000  # number of first samples in which rollouts are looked for: some may come from a log
STEPS = 60  # number of steps of rollouts in which dirt is looked for; nothing is found in fewer


def dirt_of(
    spec: dict[str, Any], tolerances: Mapping[str, float], samples: Sequence[SampleRecord]
) -> list[DirtFinding]:
    """Return the dirt in the first ``STEPS`` steps of rollouts; nothing if there are fewer, or if a query may begin
    elsewhere than at a reset.

    Args:
        spec: the stored specification.
        tolerances: tolerances that were set after the registration, by output.
        samples: the first samples of the surrogate.

    Raises:
        Damaged: the stored specification can't be read.
    """
    if read_stored(EnvironmentSpec, "a stored specification", spec).access != "reset":
        return []
    rollouts, left = [], STEPS
    rolled = sorted((s for s in samples if s.trajectory is not None), key=lambda s: (s.trajectory, s.step))
    for _, of_one in groupby(rolled, key=lambda s: s.trajectory):
        if steps := _consecutive(of_one)[:left]:
            rollouts.append(steps)
            left -= len(steps)
    now = spec | {"tolerances": spec.get("tolerances", {}) | dict(tolerances)}
    found = () if left else _found(json.dumps(now), tuple(rollouts))
    return [DirtFinding(name=name, said=said) for name, said in found]


def _consecutive(steps: Iterable[SampleRecord]) -> tuple[SampleRecord, ...]:
    """Return the steps of one rollout, in their order, up to the first that does not follow the step before it."""
    taken: list[SampleRecord] = []
    for step in steps:
        if step.step != len(taken) or (taken and step.coordinates != taken[-1].next_coordinates):
            break
        taken.append(step)
    return tuple(taken)


@lru_cache(maxsize=32)  # the first steps stay the same, while the page asks again and again
def _found(spec_json: str, rollouts: tuple[tuple[SampleRecord, ...], ...]) -> tuple[tuple[str, str], ...]:
    from surrogym_shared.dirt import Rollout, identify, sensors  # imported late: few servers need it
    from surrogym_shared.dirt.words import traits

    spec = EnvironmentSpec.model_validate_json(spec_json)
    read = np.array([c.lag is None for c in spec.coordinates])
    given = []
    for steps in rollouts:
        path = np.array([steps[0].coordinates, *(step.next_coordinates for step in steps)])
        given.append(Rollout(path[:, read], np.array([step.action for step in steps])))
    known = sensors(spec)
    return tuple(traits(identify(given, known), known, spec, given))
