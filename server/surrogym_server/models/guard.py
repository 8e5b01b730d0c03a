"""Calls to the code of a model family, which may be a plugin: its errors become messages, and its arrays are checked.

Letters of shapes are those of ``models.port``.
"""

from __future__ import annotations

import json
from contextlib import AbstractContextManager

import numpy as np
import torch
from torch import Tensor

from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.environment.samples import Samples
from surrogym_server.errors import PluginFailed, SurrogymError
from surrogym_server.models.abilities import TakesPrior
from surrogym_server.models.port import DynamicsModel, Learned, Transition, Warm
from surrogym_server.models.registry import learner_of
from surrogym_server.plugins import failed, guarded, in_one_line
from surrogym_server.tensors import gpu_failure

POINTS = 16  # number of samples at which a new model is checked


def failure_of(definition: EnvironmentDefinition, error: BaseException) -> SurrogymError:
    """Return an error whose message is one sentence: it names the model family whose code raised ``error``, or the GPU
    if that failed, and quotes ``error``."""
    return gpu_failure(error) or failed(_family(definition), PluginFailed, error)


def plugin_calls(definition: EnvironmentDefinition, *, interrupts: bool = False) -> AbstractContextManager[None]:
    """Return a context in which every error that the code of the definition's model family raises becomes
    ``PluginFailed``. ``interrupts`` is passed to ``guarded``, which explains it."""
    return guarded(_family(definition), PluginFailed, interrupts=interrupts)


def learn(
    definition: EnvironmentDefinition, samples: Samples, warm: Warm | None, prior: DynamicsModel | None = None
) -> Learned:
    """Learn a model of the family that the definition names, and check its predictions at a few of the samples.

    ``warm`` has arrays of an earlier fit, at which this fit can start. The model ``prior`` is used if the family has
    the ability ``TakesPrior``.

    Raises:
        InvalidInput: too few samples to learn from.
        NumericalFailure: the fit fails on these samples.
        PluginFailed: the family's code raised another error, or its result breaks the rules of ``models.port``.
    """
    with plugin_calls(definition):
        learner = learner_of(definition.learning.model)
        if prior is not None and isinstance(learner, TakesPrior):
            result = learner.learn_beside(prior, definition, samples, warm)
        else:
            result = learner.learn(definition, samples, warm)
        model: object = getattr(result, "model", result)
        if not isinstance(model, DynamicsModel):
            raise _wrong(
                definition,
                "expected `learn` to return a `Learned` that contains a `DynamicsModel`",
                type(model).__name__,
            )
        for name, array in result.warm.items():
            if not isinstance(array, np.ndarray) or array.dtype.kind not in "fiub":
                raise _wrong(
                    definition, f"expected the warm start {name!r} to be an array of numbers", type(array).__name__
                )
        every = max(1, len(samples) // POINTS)
        require_sound(result.model, samples.q[::every][:POINTS], samples.u[::every][:POINTS])
    return result


def require_sound(model: DynamicsModel, q: Tensor, u: Tensor) -> None:
    """Raise ``PluginFailed`` unless a model's attributes, and its predictions at q (m, C) under u (m, F), have the
    shapes that ``models.port`` states and are finite, standard deviations are not negative, and probabilities lie
    between 0 and 1."""
    definition, outputs = model.definition, len(model.definition.outputs)
    predicted = model.transition(q, u, stds=True, reward_std=True)
    require_shapes(model, predicted, q, stds=True)
    require_numbers(definition, "next coordinates", predicted.q_next, q.shape)
    require_numbers(definition, "reward", predicted.reward, q.shape[:1])
    assert predicted.std is not None
    assert predicted.reward_std is not None
    require_stds(model, torch.cat([predicted.std, predicted.reward_std[:, None]], -1))
    require_numbers(definition, "means", model.means(q, u), (len(q), outputs))
    require_numbers(definition, "scales", model.scales, (outputs,))
    if definition.learns_termination:
        ends = model.learned_termination(q)
        require_numbers(definition, "learned termination", ends, q.shape[:1])
        if bool(((ends < 0) | (ends > 1)).any()):
            raise _wrong(
                definition, "expected `learned_termination` to return probabilities from 0 to 1", f"{_worst(ends):g}"
            )
    try:
        json.dumps([model.description, list(model.structures)], allow_nan=False)
    except (TypeError, ValueError) as error:
        raise _wrong(
            definition, "expected a description and structures that JSON can represent", in_one_line(error)
        ) from error


def require_shapes(model: DynamicsModel, predicted: Transition, q: Tensor, *, stds: bool = False) -> None:
    """Raise ``PluginFailed`` unless the prediction of steps from q (m, C) has the shapes that ``models.port`` states.
    With ``stds`` it must include standard deviations."""
    definition, rows = model.definition, len(q)
    if not isinstance(predicted, Transition):
        raise _wrong(definition, "expected `transition` to return a `Transition`", type(predicted).__name__)
    _require_shape(definition, "next coordinates", predicted.q_next, q.shape)
    _require_shape(definition, "reward", predicted.reward, (rows,))
    if stds or predicted.std is not None:
        _require_shape(definition, "standard deviation", predicted.std, (rows, len(definition.outputs) - 1))
    if stds or predicted.reward_std is not None:
        _require_shape(definition, "standard deviation of the reward", predicted.reward_std, (rows,))


def require_stds(model: DynamicsModel, std: Tensor) -> None:
    """Raise ``PluginFailed`` unless standard deviations (m, O) of all outputs are finite and not negative."""
    for name, column in zip(model.definition.outputs, std.T, strict=True):
        require_numbers(model.definition, f"standard deviation of {name!r}", column, column.shape)
        if bool((column < 0).any()):
            raise _wrong(
                model.definition, f"standard deviation of {name!r}: expected at least 0", f"{float(column.min()):g}"
            )


def require_numbers(definition: EnvironmentDefinition, what: str, values: Tensor, shape: tuple[int, ...]) -> None:
    """Raise ``PluginFailed`` unless a tensor has this shape and finite numbers; ``what`` is its name in the message."""
    _require_shape(definition, what, values, shape)
    if not bool(torch.isfinite(values).all()):
        raise _wrong(definition, f"{what}: expected finite numbers", f"{_worst(values):g}")


def _require_shape(definition: EnvironmentDefinition, what: str, values: Tensor | None, shape: tuple[int, ...]) -> None:
    shape_of_values = getattr(values, "shape", None)
    if shape_of_values != shape:
        came = type(values).__name__ if shape_of_values is None else str(tuple(shape_of_values))
        raise _wrong(definition, f"{what}: expected the shape {tuple(shape)}", came)


def _worst(values: Tensor) -> float:
    """Return a value that is not finite if there is one, otherwise the value farthest from 0."""
    return float(values.flatten()[torch.where(values.isfinite(), values.abs(), torch.inf).argmax()])


def _wrong(definition: EnvironmentDefinition, expected: str, got: str) -> PluginFailed:
    return PluginFailed(f"{_family(definition)}: {expected}, got {got}")


def _family(definition: EnvironmentDefinition) -> str:
    return f"the model family {definition.learning.model.name!r}"
