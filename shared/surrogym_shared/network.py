"""A policy network as plain arrays, with layers of tanh or ReLU, for policy searches without a deep-learning library.

Shapes: leading dimensions (...) stand for several policies at once; N observations, D observation entries, A outputs,
F action entries.
"""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, Field, PositiveInt, ValidationError

from surrogym_shared.integrals import Error
from surrogym_shared.kinds import Activation
from surrogym_shared.policy_sizes import MAX_LAYERS
from surrogym_shared.spec import Action, BoxAction, EnvironmentSpec

if TYPE_CHECKING:
    from surrogym_shared.archives import Header

Array = NDArray[np.float64]
HEAD = "surrogym-network.json"
ARRAYS = "network.npz"
MAX_BYTES = 16 * 1024 * 1024  # largest size in bytes of a policy's file after decompression
MAX_HEAD_BYTES = 64 * 1024
OUTSIDE = ("mean", "deviation", "low", "high")  # names of the arrays in a policy's file that belong to no layer


class Layer(NamedTuple):
    """One layer of a network, which computes x @ weights + bias."""

    weights: NDArray[np.floating[Any]]  # (..., I, O) factors from each of I inputs to each of O outputs
    bias: NDArray[np.floating[Any]]  # (..., O) constant that is added to each of O outputs


class _Head(BaseModel):
    """JSON header in the file of a policy network. In a file of version 1 there is one hidden layer, with tanh."""

    version: Literal[1, 2]
    counts: tuple[PositiveInt, ...]
    activation: Activation = "tanh"
    layers: Annotated[int, Field(ge=1, le=MAX_LAYERS)] = 2
    integrals: tuple[Error, ...] = ()

    @property
    def names(self) -> list[tuple[str, str]]:
        """Return the names of the weights and the bias of each layer in the file."""
        if self.version == 1:
            return [("hidden", "hidden_bias"), ("output", "output_bias")]
        return [(f"weights{i}", f"bias{i}") for i in range(self.layers)]


@dataclass(frozen=True)
class Network:
    """Policy network: it standardises observations and returns actions.

    Continuous actions are tanh of the outputs, scaled to the bounds. Of discrete choices, the most probable is taken.

    ``counts`` are the numbers of choices of each entry of a discrete action. They are empty for a continuous action,
    whose bounds are ``low`` and ``high`` (F,).
    """

    mean: Array  # (D,) mean of each of D observation entries, which is subtracted
    deviation: Array  # (D,) number by which each of D observation entries minus its mean is divided
    layers: tuple[Layer, ...]
    low: Array
    high: Array
    counts: tuple[int, ...] = ()
    activation: Activation = "tanh"  # activation function of the hidden layers
    # errors whose integrals follow the environment's own entries in an observation, if the sampler computes them
    integrals: tuple[Error, ...] = ()

    @classmethod
    def of(
        cls, spec: EnvironmentSpec, mean: Array, deviation: Array, units: int | Sequence[int], vector: Array
    ) -> Self:
        """Make policies from vectors of parameters (..., p), with p as ``size`` returns it. ``mean`` and ``deviation``
        (D,) standardise observations; ``units`` are the sizes of the hidden layers. Weights are entries of a vector,
        divided by sqrt(number of layer inputs)."""
        layers, begin = [], 0
        for inputs, outputs in pairwise(_sizes(spec, units)):
            middle, end = begin + inputs * outputs, begin + (inputs + 1) * outputs
            weights = vector[..., begin:middle].reshape(*vector.shape[:-1], inputs, outputs)
            layers.append(Layer(weights / np.sqrt(inputs), vector[..., middle:end]))
            begin = end
        return cls(mean, deviation, tuple(layers), *bounds_of(spec), spec.action.policy_counts)

    @staticmethod
    def size(spec: EnvironmentSpec, units: int | Sequence[int]) -> int:
        """Return the number of parameters of a policy. ``units`` is the size of its hidden layer, or of each of
        them."""
        return sum((inputs + 1) * outputs for inputs, outputs in pairwise(_sizes(spec, units)))

    @property
    def vector(self) -> Array:
        """Return the parameters of one policy as the vector from which ``of`` makes it."""
        parts = [(layer.weights * np.sqrt(len(layer.weights)), layer.bias) for layer in self.layers]
        return np.concatenate([part.ravel() for layer in parts for part in layer])

    def __call__(self, observation: NDArray[Any]) -> NDArray[Any]:
        """Return actions of F entries (..., N, F) for N observations of D entries (..., N, D). For an action of one
        discrete entry, they are int64 (..., N)."""
        return most_probable(self.outputs(observation), self.low, self.high, self.counts)

    def outputs(self, observation: NDArray[Any]) -> NDArray[np.floating[Any]]:
        """Return the A outputs (..., N, A) of the last layer for N observations (..., N, D): continuous actions before
        their tanh, or scores of discrete choices."""
        x = (np.asarray(observation, dtype=np.float64) - self.mean) / self.deviation
        return forward(self.layers, self.activation, x)

    def save(self, path: Path) -> None:
        """Write one policy to a zip file with its arrays and a JSON header. The file contains no code."""
        path.write_bytes(self.to_bytes())

    def to_bytes(self) -> bytes:
        """Return the content of the file that ``save`` writes."""
        head = _Head(
            version=2,
            counts=self.counts,
            activation=self.activation,
            layers=len(self.layers),
            integrals=self.integrals,
        )
        arrays = {name: getattr(self, name) for name in OUTSIDE}
        for names, layer in zip(head.names, self.layers, strict=True):
            arrays |= dict(zip(names, layer, strict=True))
        content = io.BytesIO()
        with zipfile.ZipFile(content, "w") as file:
            file.writestr(HEAD, json.dumps(head.model_dump()))
            with file.open(ARRAYS, "w") as archive:
                np.savez(archive, **arrays)
        return content.getvalue()

    @classmethod
    def load(cls, path: Path | bytes) -> Self:
        """Read a file that ``save`` wrote, given its path or its content.

        Raises:
            ValueError: the file can't be read, was not written by ``save``, or has more than ``MAX_BYTES`` bytes.
        """
        # Imported here, because only reading a file needs it.
        from surrogym_shared.archives import read_arrays, read_entries, require_finite

        try:
            entries = read_entries(path, MAX_BYTES)
            head = _read_head(entries[HEAD])
            arrays = read_arrays(entries[ARRAYS], MAX_BYTES, partial(_require_chain, head))
            require_finite(arrays, positive="deviation")
        except (LookupError, TypeError, OSError, ValueError, RecursionError, MemoryError) as error:
            named = path if isinstance(path, Path) else "the content"
            raise ValueError(
                f"{named} is not a policy of surrogym train: {error}; save or download the policy again"
            ) from error
        layers = tuple(Layer(*(arrays[name] for name in names)) for names in head.names)
        outside = {name: arrays[name] for name in OUTSIDE}
        return cls(**outside, layers=layers, counts=head.counts, activation=head.activation, integrals=head.integrals)

    def require_fit(self, entries: int, action: Action) -> None:
        """Raise ``ValueError`` if the policy does not read observations of ``entries`` entries and its integrals, or
        has other actions than ``action``."""
        wanted = _form(entries + len(self.integrals), action.policy_counts or action.size)
        got = _form(len(self.mean), self.counts or len(self.low))
        if got != wanted:
            raise ValueError(f"expected a policy of {wanted}, got one of {got}")

    @staticmethod
    def is_at(path: Path) -> bool:
        """Whether a file is a zip file with the header that ``save`` writes."""
        from surrogym_shared.archives import has_entry

        return has_entry(path, HEAD)


def forward(layers: Sequence[Layer], activation: Activation, x: NDArray[np.floating[Any]]) -> NDArray[np.floating[Any]]:
    """Return the A outputs of a network's layers for N inputs of D entries: (..., N, A) for ``x`` (..., N, D)."""
    *hidden, last = layers
    for weights, bias in hidden:
        x = x @ weights + bias[..., None, :]
        x = np.tanh(x) if activation == "tanh" else np.maximum(x, 0)
    scores: NDArray[np.floating[Any]] = x @ last.weights + last.bias[..., None, :]
    return scores


def most_probable(y: NDArray[np.floating[Any]], low: Array, high: Array, counts: tuple[int, ...]) -> NDArray[Any]:
    """Return the most probable actions (..., N, F) for the network's outputs y (..., N, A).

    For an action of one discrete entry, they are int64 (..., N). ``low`` and ``high`` (F,) are the bounds of a
    continuous action; ``counts`` are the numbers of choices of a discrete one.
    """
    if not counts:
        centre, reach = (low + high) / 2, (high - low) / 2
        return np.asarray(centre + reach * np.tanh(y), dtype=np.float32)
    groups = np.split(y, np.cumsum(counts)[:-1], axis=-1)
    choices = [group.argmax(-1) for group in groups]
    return choices[0] if len(choices) == 1 else np.stack(choices, -1)


def bounds_of(spec: EnvironmentSpec) -> tuple[Array, Array]:
    """Return the lower and the upper bounds (F,) of a continuous action of F entries; both empty for a discrete one."""
    if isinstance(spec.action, BoxAction):
        return np.array(spec.action.low), np.array(spec.action.high)
    return np.zeros(0), np.zeros(0)


def _form(entries: int, actions: int | tuple[int, ...]) -> str:
    """Describe a policy by its observation entries, and its number of continuous actions or of discrete choices."""
    choices = f"{actions} continuous" if isinstance(actions, int) else f"discrete ({' and '.join(map(str, actions))})"
    return f"{entries} observation entries and {choices} actions"


def _sizes(spec: EnvironmentSpec, units: int | Sequence[int]) -> list[int]:
    """Return the numbers of inputs, hidden units and outputs of a policy. Without hidden units it is linear."""
    hidden = ([units] if units else []) if isinstance(units, int) else units
    return [len(spec.observation), *hidden, sum(spec.action.policy_counts) or spec.action.size]


def _read_head(content: bytes) -> _Head:
    if len(content) > MAX_HEAD_BYTES:
        raise ValueError(
            f"expected the entry {HEAD} of a policy's file to have at most {MAX_HEAD_BYTES} bytes, got {len(content)}"
        )
    try:
        return _Head.model_validate_json(content)
    except ValidationError as error:
        from surrogym_shared.faults import first_fault  # imported here, because only an error needs it

        raise ValueError(f"the entry {HEAD} of the policy's file is invalid: {first_fault(error)}") from error


def _require_chain(head: _Head, headers: Mapping[str, Header]) -> None:
    """Check by their headers that the arrays of a file are those of one policy, with layers and bounds that fit.

    Shapes have to match without broadcasting, which could compute far larger arrays than the file contains.

    Raises:
        ValueError: the arrays don't fit.
    """
    names = {*OUTSIDE, *(name for names in head.names for name in names)}
    if names != set(headers):
        raise ValueError(
            f"expected the arrays {', '.join(sorted(names))} of a network, got {', '.join(sorted(headers)) or 'none'}"
        )
    for name, shape in _chained(head, headers).items():
        header = headers[name]
        if header.shape != shape or header.dtype.kind != "f":
            raise ValueError(f"expected {name} as floats of shape {shape}, got {header.dtype} of {header.shape}")
    outputs = headers[head.names[-1][1]].shape[0]
    if head.counts and sum(head.counts) != outputs:
        raise ValueError(f"expected {sum(head.counts)} outputs, one for each choice of an action, got {outputs}")


def _chained(head: _Head, headers: Mapping[str, Header]) -> dict[str, tuple[int, ...]]:
    """Return the shape that each array of a policy must have, given the shapes of mean and biases in ``headers``."""

    def length(name: str) -> int:
        return (headers[name].shape or (0,))[0]

    size = length("mean")
    shapes: dict[str, tuple[int, ...]] = {"mean": (size,), "deviation": (size,)}
    for weights, bias in head.names:
        shapes |= {weights: (size, length(bias)), bias: (length(bias),)}
        size = length(bias)
    # If the action is discrete, the arrays low and high may be empty.
    limits = (length("low") if head.counts else size,)
    return shapes | {"low": limits, "high": limits}
