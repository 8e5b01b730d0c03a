"""The paper's policy as plain arrays: one hidden layer of tanh. Made by searches that need no trainer's library.

Leading dimensions (...) stand for several policies at once. D observation entries, H hidden units, A outputs.
"""

from __future__ import annotations

import json
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, PositiveInt, ValidationError

from surrogym_shared.archives import Header, read_arrays, read_entries
from surrogym_shared.spec import BoxAction, DiscreteAction, EnvironmentSpec, MultiDiscreteAction

Array = NDArray[np.float64]
HEAD = "surrogym-network.json"
ARRAYS = "network.npz"
MAX_BYTES = 16 * 1024 * 1024  # of a file's contents
MAX_HEAD_BYTES = 64 * 1024


class _Head(BaseModel):
    """The JSON head of a file."""

    version: Literal[1]
    counts: tuple[PositiveInt, ...]


@dataclass(frozen=True)
class Network:
    """Standardised observations, one tanh layer, then tanh scaled to the action's bounds, or the most probable choice.

    ``counts`` are the choices of each entry of a discrete action, empty for a continuous one, whose bounds are
    ``low`` and ``high`` (F,).
    """

    mean: Array  # (D,)
    deviation: Array  # (D,)
    hidden: Array  # (..., D, H)
    hidden_bias: Array  # (..., H)
    output: Array  # (..., H, A)
    output_bias: Array  # (..., A)
    low: Array
    high: Array
    counts: tuple[int, ...] = ()

    @classmethod
    def of(cls, spec: EnvironmentSpec, mean: Array, deviation: Array, units: int, vector: Array) -> Self:
        """The policies whose parameters are vectors (..., ``size``), layer weights in units of 1 / sqrt(inputs)."""
        d, a = len(mean), sum(counts_of(spec)) or spec.action.size
        shapes = [(d, units), (units,), (units, a), (a,)]
        ends = np.cumsum([int(np.prod(shape)) for shape in shapes])
        parts = np.split(vector, ends[:-1], axis=-1)
        hidden, hidden_bias, output, output_bias = (
            part.reshape(*vector.shape[:-1], *shape) for part, shape in zip(parts, shapes, strict=True)
        )
        low, high = bounds_of(spec)
        weights = (hidden / np.sqrt(d), hidden_bias, output / np.sqrt(units), output_bias)
        return cls(mean, deviation, *weights, low, high, counts_of(spec))

    @staticmethod
    def size(spec: EnvironmentSpec, units: int) -> int:
        """How many parameters a policy has."""
        d, a = len(spec.observation), sum(counts_of(spec)) or spec.action.size
        return (d + 1) * units + (units + 1) * a

    @property
    def vector(self) -> Array:
        """The parameters of one policy, as ``of`` takes them."""
        d, units = self.hidden.shape
        parts = (self.hidden * np.sqrt(d), self.hidden_bias, self.output * np.sqrt(units), self.output_bias)
        return np.concatenate([part.ravel() for part in parts])

    def __call__(self, observation: NDArray[Any]) -> NDArray[Any]:
        """Actions (..., N, F) of observations (..., N, D); int64 (..., N) where there is one discrete choice."""
        x = (np.asarray(observation, dtype=np.float64) - self.mean) / self.deviation
        y = np.tanh(x @ self.hidden + self.hidden_bias[..., None, :]) @ self.output + self.output_bias[..., None, :]
        if not self.counts:
            centre, reach = (self.low + self.high) / 2, (self.high - self.low) / 2
            return np.asarray(centre + reach * np.tanh(y), dtype=np.float32)
        groups = np.split(y, np.cumsum(self.counts)[:-1], axis=-1)
        chosen = [group.argmax(-1) for group in groups]
        return chosen[0] if len(chosen) == 1 else np.stack(chosen, -1)

    def save(self, path: Path) -> None:
        """Write one policy: a zip of arrays and a JSON head, nothing in it is code."""
        names = [name for name in self.__dataclass_fields__ if name != "counts"]
        with zipfile.ZipFile(path, "w") as file:
            file.writestr(HEAD, json.dumps({"version": 1, "counts": self.counts}))
            with file.open(ARRAYS, "w") as arrays:
                np.savez(arrays, **{name: getattr(self, name) for name in names})

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read what ``save`` wrote. Raises ValueError where it is something else, or has more than ``MAX_BYTES``."""
        try:
            entries = read_entries(path, MAX_BYTES)
            counts = _read_counts(entries[HEAD])
            arrays = read_arrays(entries[ARRAYS], MAX_BYTES, partial(_require_chain, counts))
        except (LookupError, TypeError, OSError, ValueError, RecursionError, MemoryError) as error:
            raise ValueError(f"{path} is no network of arrays: {error}") from error
        return cls(**arrays, counts=counts)

    @staticmethod
    def is_at(path: Path) -> bool:
        """Whether a file looks like what ``save`` writes."""
        try:
            with zipfile.ZipFile(path) as file:
                return HEAD in file.namelist()
        except zipfile.BadZipFile:
            return False


def counts_of(spec: EnvironmentSpec) -> tuple[int, ...]:
    """The choices of each entry of a policy's action; empty for a continuous one."""
    match spec.action:
        case BoxAction(bins=bins):
            return bins or ()
        case DiscreteAction(n=n):
            return (n,)
        case MultiDiscreteAction(nvec=nvec):
            return nvec


def bounds_of(spec: EnvironmentSpec) -> tuple[Array, Array]:
    """Bounds (F,) of a continuous action, empty for a discrete one."""
    if isinstance(spec.action, BoxAction):
        return np.array(spec.action.low), np.array(spec.action.high)
    return np.zeros(0), np.zeros(0)


def _read_counts(head: bytes) -> tuple[int, ...]:
    if len(head) > MAX_HEAD_BYTES:
        raise ValueError(f"expected {HEAD} of at most {MAX_HEAD_BYTES} bytes, got {len(head)}")
    try:
        return _Head.model_validate_json(head).counts
    except ValidationError as error:
        first = error.errors()[0]
        raise ValueError(f"{HEAD}: {'.'.join(map(str, first['loc']))}: {first['msg']}") from error


def _require_chain(counts: tuple[int, ...], headers: Mapping[str, Header]) -> None:
    """Raise ValueError unless the arrays are those of one policy, whose layers and bounds fit together.

    Shapes that merely broadcast are refused: a call would compute far larger arrays than the file holds.
    """
    names = {name for name in Network.__dataclass_fields__ if name != "counts"}
    if names != set(headers):
        raise ValueError(f"expected the arrays {', '.join(sorted(names))}, got {', '.join(sorted(headers)) or 'none'}")
    for name, shape in _chained(counts, headers).items():
        header = headers[name]
        if header.shape != shape or header.dtype.kind != "f":
            raise ValueError(f"expected {name} as floats of shape {shape}, got {header.dtype} of {header.shape}")
    if counts and sum(counts) != headers["output_bias"].shape[0]:
        raise ValueError(f"expected {sum(counts)} outputs for the counts, got {headers['output_bias'].shape[0]}")


def _chained(counts: tuple[int, ...], headers: Mapping[str, Header]) -> dict[str, tuple[int, ...]]:
    """The shapes of one policy with as many observation entries, hidden units and outputs as the headers name."""
    d, units, outputs, bounds = (
        (headers[name].shape or (0,))[0] for name in ("mean", "hidden_bias", "output_bias", "low")
    )
    layers = {"hidden": (d, units), "hidden_bias": (units,), "output": (units, outputs), "output_bias": (outputs,)}
    limits = (bounds if counts else outputs,)  # a discrete action may have none
    return {"mean": (d,), "deviation": (d,), **layers, "low": limits, "high": limits}
