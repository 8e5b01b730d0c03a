"""Export a surrogate from a server to one file, and import it from a file to a server."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from itertools import groupby
from typing import Literal

import numpy as np

from surrogym_client.errors import SpecConflict, SurrogymClientError
from surrogym_client.transport.api import Api
from surrogym_shared.states import PURPOSES
from surrogym_shared.surrogate_file import RealSamples, SurrogateFile
from surrogym_shared.wire import NewSample, SurrogateView

BATCH = 1_024  # largest number of samples in one request


class NotImportable(SurrogymClientError):
    """A surrogate can't be imported under this name, because the name is in use."""


def export_surrogate(api: Api, name: str) -> SurrogateFile:
    """Return a surrogate with its latest model and all its samples.

    Raises:
        NoModel: there was no fit yet.
        SurrogymClientError: the server can't be reached, or refuses the request.
    """
    latest, view = api.model(name), api.surrogate(name)
    return SurrogateFile(
        name,
        view.spec,
        api.export_model(name, latest.version),
        _samples(api, name),
        tolerances={output.name: output.tolerance for output in latest.fidelity.outputs},
        ledger=view.ledger.model_dump(include=set(PURPOSES)),
    )


def import_surrogate(
    api: Api, file: SurrogateFile, name: str | None = None, progress: Callable[[float], None] = lambda _: None
) -> SurrogateView:
    """Create a surrogate from a file. It serves the same model at once, with the same tolerances.

    Its design is paused. Samples of a log stay logged ones, and all others count as manual ones. If anything fails, or
    Ctrl-C is pressed, the new surrogate is deleted again. A surrogate that another request created is never changed.

    Args:
        api: the server; the token needs the role admin.
        file: the surrogate.
        name: name of the new surrogate; None takes the file's.
        progress: called with the share of the samples that has been sent, in [0, 1].

    Raises:
        NotImportable: there is a surrogate of this name.
        InvalidInput: the model does not fit the specification.
        SurrogymClientError: the server can't be reached, or refuses the request.
    """
    name = name or file.name
    if not _created(api, name, file):
        raise NotImportable(f"a surrogate named {name!r} exists already on the server: give another name by --name")
    try:
        api.patch_surrogate(name, paused=True, tolerances=file.tolerances or None)
        api.import_model(name, file.model)
        for rows in _batches(file.samples):
            progress(rows[0] / len(file.samples))
            purpose: Literal["logged", "manual"] = "logged" if _is_logged(file.samples, rows[0]) else "manual"
            api.add_samples(name, "import", [_sample(file.samples, row) for row in rows], purpose=purpose)
        progress(1.0)
        return api.surrogate(name)
    except BaseException:
        api.delete_surrogate(name)
        raise


def _created(api: Api, name: str, file: SurrogateFile) -> bool:
    """Create the surrogate, and return whether the name was free. The server decides this, so that only one of two
    simultaneous imports succeeds."""
    try:
        return api.create_surrogate(name, file.spec).created
    except SpecConflict:
        return False


def _samples(api: Api, name: str) -> RealSamples:
    spec, views = api.surrogate(name).spec, list(api.samples(name))
    c, f = len(spec.coordinates), spec.action.size
    return RealSamples(
        coordinates=np.array([view.coordinates for view in views], dtype=np.float64).reshape(-1, c),
        action=np.array([view.action for view in views], dtype=np.float64).reshape(-1, f),
        next_coordinates=np.array([view.next_coordinates for view in views], dtype=np.float64).reshape(-1, c),
        reward=np.array([view.reward for view in views], dtype=np.float64),
        terminated=np.array([view.terminated for view in views], dtype=np.bool_),
        truncated=np.array([view.truncated for view in views], dtype=np.bool_),
        logged=logged if (logged := np.array([view.purpose == "logged" for view in views])).any() else None,
    )


def _batches(samples: RealSamples) -> Iterator[list[int]]:
    """Yield the indices of the samples in order, in batches. A batch has only samples of a log, or none of them."""
    for _, group in groupby(range(len(samples)), partial(_is_logged, samples)):
        rows = list(group)
        yield from (rows[first : first + BATCH] for first in range(0, len(rows), BATCH))


def _is_logged(samples: RealSamples, row: int) -> bool:
    return samples.logged is not None and bool(samples.logged[row])


def _sample(samples: RealSamples, i: int) -> NewSample:
    return NewSample(
        coordinates=samples.coordinates[i].tolist(),
        action=samples.action[i].tolist(),
        next_coordinates=samples.next_coordinates[i].tolist(),
        reward=float(samples.reward[i]),
        terminated=bool(samples.terminated[i]),
        truncated=bool(samples.truncated[i]),
    )
