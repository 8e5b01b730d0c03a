"""Storage of an evaluation's real steps in a file until a server has them. ``surrogym import`` reads such a file."""

from __future__ import annotations

import os
from collections.abc import Sequence
from itertools import count
from pathlib import Path

import numpy as np

from surrogym_shared.logs.drafting import wrapped
from surrogym_shared.logs.table import MAX_MEASURED
from surrogym_shared.logs.writing import EVALUATED, npz_of_steps
from surrogym_shared.spec import EnvironmentSpec
from surrogym_shared.wire import NewSample
from surrogym_trainer.evaluation.comparing import StepOfEpisode


def is_storable(step: StepOfEpisode) -> bool:
    """Return whether a server can store the numbers of a step."""
    numbers = np.array([*step.coordinates, *step.action, *step.next_coordinates, step.reward])
    return bool((np.abs(numbers) <= MAX_MEASURED).all())


def as_logged(spec: EnvironmentSpec, samples: Sequence[NewSample]) -> list[NewSample]:
    """Return steps in the form in which an import would send them: with wrapped angles.

    The server recognises the steps of a log by their values, to the last bit. So steps that it has stored already count
    as duplicates in an import. Equal steps within the list are all kept, because each was taken.
    """
    angles = [i for i, coordinate in enumerate(spec.coordinates) if coordinate.kind == "angle"]
    return [_with_wrapped(angles, sample) for sample in samples]


def write_steps(policy: Path, spec: EnvironmentSpec, samples: Sequence[NewSample]) -> Path:
    """Write steps to a new file beside a policy, such as ``policy.steps.npz``, and return its path. If the folder can't
    be written to, the file is written to the working directory. An existing file is never replaced, because it
    contains other steps.

    Raises:
        OSError: neither folder can be written to.
    """
    content = _content(spec, samples)
    try:
        return _write_new(policy.parent, policy.stem, content)
    except OSError:
        return _write_new(Path(), policy.stem, content)


def rewrite_steps(file: Path, spec: EnvironmentSpec, samples: Sequence[NewSample]) -> None:
    """Replace the steps in a file that ``write_steps`` wrote. Raises ``OSError`` if that fails; the file then stays
    unchanged."""
    part = file.with_suffix(".part")
    part.write_bytes(_content(spec, samples))
    os.replace(part, file)


def _content(spec: EnvironmentSpec, samples: Sequence[NewSample]) -> bytes:
    fields = ("coordinates", "action", "next_coordinates", "reward", "terminated")
    arrays = {name: np.array([getattr(sample, name) for sample in samples]) for name in fields}
    return npz_of_steps(spec.coordinate_names, arrays | {EVALUATED: np.array(True)})


def _write_new(folder: Path, stem: str, content: bytes) -> Path:
    for number in count(1):
        file = folder / f"{stem}.steps{'' if number == 1 else f'-{number}'}.npz"
        try:
            opened = file.open("xb")
        except FileExistsError:
            continue
        try:
            with opened:
                opened.write(content)
        except OSError:
            file.unlink(missing_ok=True)
            raise
        return file
    raise AssertionError("unreachable: the loop over file numbers does not end")


def _with_wrapped(angles: Sequence[int], sample: NewSample) -> NewSample:
    if not angles:
        return sample
    return sample.model_copy(
        update={name: _wrapped(angles, getattr(sample, name)) for name in ("coordinates", "next_coordinates")}
    )


def _wrapped(angles: Sequence[int], values: Sequence[float]) -> list[float]:
    turned = np.array(values)
    turned[list(angles)] = wrapped(turned[list(angles)])
    return [float(value) for value in turned]
