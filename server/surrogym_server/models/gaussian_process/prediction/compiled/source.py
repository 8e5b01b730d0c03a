"""The step of a model as C99 source: ``step.c``, which is the same for all models, and the tables of one model."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from importlib.resources import files

import numpy as np
from numpy.typing import NDArray

from surrogym_server.compiled.tables import Tables, TablesBuilder
from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.gp.compiled import COUNT, HEAD, KEPT, TURNED
from surrogym_server.models.abilities import StepSource
from surrogym_server.models.gaussian_process.prediction.compiled import layout
from surrogym_server.models.gaussian_process.prediction.compiled.regions import CLASSIFIES, SECOND
from surrogym_server.models.gaussian_process.prediction.warp import LARGEST
from surrogym_server.tensors import EDGE

Floats = NDArray[np.float64]
FIXED = ("step.c", "step.h")
PER_LINE = 8  # a line of the C source contains this many numbers
PROCESS = 3  # in the matrix of all processes, the column with the index of each process's first matrix


def step_source(definition: EnvironmentDefinition, tables: Tables) -> StepSource:
    """Return C source of the functions that compute a step of a model. ``tables`` are the model's tables, the result of
    ``compiled.step.tables_of``."""
    matrices = _matrices(tables)
    processes = {int(place) for place in _processes(matrices)}
    for process in processes:
        for drawn in (KEPT, TURNED):  # the C source omits these matrices, because only sampled functions need them
            matrices[process + drawn] = np.zeros((1, 0))
    inner = {process + place for process in processes for place in range(HEAD, TURNED + 1)}
    sizes = {
        "COORDINATES": len(definition.coordinates),
        "ACTIONS": definition.action.size,
        "OBSERVATIONS": len(definition.observation_names),
        "OUTPUTS": len(definition.outputs),
        "MOST_WIDTH": max(max(one.shape) for place, one in enumerate(matrices) if place not in inner),
        "MOST_POINTS": max([1, *(int(matrices[process + HEAD][0, COUNT]) for process in processes)]),
        "EDGE": EDGE,
        "LARGEST": LARGEST,
    }
    builder = TablesBuilder()
    builder.add(*matrices)
    numbers, places = builder.build()
    own = files(__package__)
    fixed = {name: (own / name).read_text(encoding="utf-8") for name in FIXED}
    return StepSource(fixed | {"tables.h": "\n".join(_header(sizes, numbers, places))}, numbers.size)


def _matrices(tables: Tables) -> list[Floats]:
    numbers, places = tables
    return [numbers[begin : begin + rows * width].reshape(rows, width) for begin, rows, width in places.tolist()]


def _processes(matrices: Sequence[Floats]) -> Iterator[float]:
    """Yield the index of the first matrix of each process: first of the outputs' processes, then of the classifiers in
    learned regions."""
    head = matrices[layout.HEAD][0].astype(int)
    yield from matrices[head[layout.PROCESSES]][:, PROCESS]
    regions = [] if head[layout.JUMPS] == layout.NONE else [int(jump[1]) for jump in matrices[head[layout.JUMPS]]]
    regions += [] if head[layout.ENDING] == layout.NONE else [head[layout.ENDING]]
    for region in regions:
        yield from (form[SECOND] for form in matrices[region] if form[CLASSIFIES] and form[SECOND] >= 0)


def _header(sizes: Mapping[str, float], numbers: Floats, places: NDArray[np.int64]) -> Iterator[str]:
    yield "/* Tables of one model, which step.c reads. Numbers are written so that float64 reads them back exactly. */"
    yield from (f"#define {name} {size}" for name, size in sizes.items())
    yield f"static const double numbers[{numbers.size}] = {{"
    written = [repr(number).replace("inf", "INFINITY") for number in numbers.tolist()]
    yield from (", ".join(written[begin : begin + PER_LINE]) + "," for begin in range(0, len(written), PER_LINE))
    yield "};"
    yield f"static const int places[{len(places)}][3] = {{ /* begin in the numbers, rows, columns */"
    yield from (f"{{{begin}, {rows}, {width}}}," for begin, rows, width in places.tolist())
    yield "};\n"
