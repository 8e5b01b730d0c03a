"""The paper's policy as plain arrays: one hidden layer of tanh. Made by searches that need no trainer's library.

Leading dimensions (...) stand for several policies at once. D observation entries, H hidden units, A outputs.
"""

from __future__ import annotations

import json
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from surrogym_shared.archives import read_arrays, read_entries
from surrogym_shared.spec import BoxAction, DiscreteAction, EnvironmentSpec, MultiDiscreteAction

Array = NDArray[np.float64]
HEAD = "surrogym-network.json"
ARRAYS = "network.npz"
MAX_BYTES = 16 * 1024 * 1024  # of a file's contents


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
            counts = tuple(int(count) for count in json.loads(entries[HEAD])["counts"])
            network = cls(**read_arrays(entries[ARRAYS], MAX_BYTES), counts=counts)
            network(np.zeros((1, len(network.mean))))  # arrays that do not fit together are refused here
        except (LookupError, TypeError, OSError, ValueError, RecursionError) as error:
            raise ValueError(f"{path} is no network of arrays: {error}") from error
        return network

    @staticmethod
    def is_at(path: Path) -> bool:
        """Whether a file looks like what ``save`` writes."""
        if not zipfile.is_zipfile(path):
            return False
        with zipfile.ZipFile(path) as file:
            return HEAD in file.namelist()


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
