"""Functions sampled with uncertain hyperparameters: from several models of the same samples.

Few samples can't determine a length scale, but a model with the optimal hyperparameters treats it as certain. So a
function is sampled in two steps: choose one of several models with equal probability, then sample a function of its
processes. A sampled function consists of the index of its model and the weights for this model.

A sampled function contains no noise. So if a process explains its samples by noise that repeated steps don't show,
sampled functions would lack the variation that it takes for noise. The hyperparameters of such a process are sampled
without this noise: the functions pass through the samples, and vary as much as the samples require. If no step can be
repeated, noise can't be distinguished from misfit, and the noise is kept.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.errors import NumericalFailure
from surrogym_server.gp import MOST_NOISE, Hyperparameters, Posterior, condition, hyperparameter_samples
from surrogym_server.models.abilities import ArraySteps, ArrayTransition, CompiledSteps, FunctionDraws
from surrogym_server.models.gaussian_process.prediction.output_model import OutputModel
from surrogym_server.models.port import Transition
from surrogym_server.tensors import fetched

MODELS = 8  # number of models with different hyperparameters, from which functions are sampled
MOST_POINTS = 128  # hyperparameters of a process with more points are certain enough, so they are not sampled
# A learned noise variance up to this share of the output's variance is never a misfit. If a process misfits, sampled
# hyperparameters have at most this noise variance.
NEGLIGIBLE = 0.01**2
# A process misfits if its learned noise variance exceeds that of repeated steps by more than this factor. The factor is
# large because repeated steps may be few.
AT_MOST = 3.0**2

Floats = NDArray[np.float64]


def uncertain_outputs(outputs: Sequence[OutputModel], *, repeatable: bool) -> list[list[OutputModel]]:
    """Return ``MODELS`` (8) copies of all outputs (O,), computed on the CPU. In each copy, processes with few points
    have other, sampled hyperparameters.

    Return [] if no process has few points. ``repeatable`` says whether the same real step can be taken again, which
    would show noise. If so, learned noise that repeated steps don't confirm is left out.
    """
    if not any(_uncertain(output) for output in outputs):
        return []
    columns = [_sampled(output, seed, repeatable) for seed, output in enumerate(outputs)]
    return [list(row) for row in zip(*columns, strict=True)]


def _uncertain(output: OutputModel) -> bool:
    posterior = output.posterior
    return posterior is not None and posterior.sparse is None and len(posterior.y) <= MOST_POINTS


def _sampled(output: OutputModel, seed: int, repeatable: bool) -> list[OutputModel]:
    posterior = output.posterior
    if posterior is None or not _uncertain(output):
        return [output] * MODELS
    most = NEGLIGIBLE if repeatable and _misfits(posterior) else MOST_NOISE
    hypers = hyperparameter_samples(posterior, MODELS, seed, output.noise_floor, most)
    return [replace(output, posterior=_conditioned(posterior, hyper)) for hyper in hypers]


def _misfits(posterior: Posterior) -> bool:
    """Return whether a process has learned clearly more noise than its points with equal inputs (repeated steps)
    show."""
    return posterior.hyper.noise_variance > max(NEGLIGIBLE, AT_MOST * (posterior.noise_seen or 0.0))


def _conditioned(posterior: Posterior, hyper: Hyperparameters) -> Posterior:
    """Return the process with the hyperparameters ``hyper``, or unchanged if its covariance can't be factored with
    them."""
    try:
        return condition(hyper, posterior.x, posterior.y)
    except NumericalFailure:
        return posterior


@dataclass(frozen=True)
class FunctionsOfSeveral(FunctionDraws, CompiledSteps):
    """Sampler of functions of several models: it chooses one of the models with equal probability, then samples a
    function of this model. Functions of all models have the same number of weights."""

    models: tuple[FunctionDraws, ...]

    @property
    def path_size(self) -> int:
        return 1 + self.models[0].path_size

    def draw(self, noise: Tensor) -> Tensor:
        count = len(self.models)
        number = (count * torch.special.ndtr(noise[:, 0])).long().clamp_max(count - 1)
        paths = torch.empty_like(noise)
        paths[:, 0] = number
        for index, rows in _members(number, count):
            paths[rows, 1:] = self.models[index].draw(noise[rows, 1:])
        return paths

    def transition_along(
        self,
        paths: Tensor,
        q: Tensor,
        u: Tensor,
        *,
        process: Tensor | None = None,
        stds: bool = False,
        reward_std: bool = False,
    ) -> Transition:
        parts, places = [], []
        for index, rows in _members(paths[:, 0].long(), len(self.models)):
            places.append(rows)
            parts.append(
                self.models[index].transition_along(
                    paths[rows, 1:],
                    q[rows],
                    u[rows],
                    process=None if process is None else process[rows],
                    stds=stds,
                    reward_std=reward_std,
                )
            )
        order = torch.argsort(torch.cat(places))
        return Transition(
            torch.cat([part.q_next for part in parts])[order],
            torch.cat([part.reward for part in parts])[order],
            _join([part.std for part in parts], order),
            _join([part.reward_std for part in parts], order),
        )

    def compiled(self) -> ArraySteps | None:
        steps = [model.compiled() if isinstance(model, CompiledSteps) else None for model in self.models]
        able = tuple(step for step in steps if step is not None)
        return StepsOfSeveral(able[0].definition, able) if len(able) == len(steps) else None

    def compiled_pays(self, *, stds: bool) -> bool:
        first = self.models[0]
        return isinstance(first, CompiledSteps) and first.compiled_pays(stds=stds)


@dataclass(frozen=True, eq=False)
class StepsOfSeveral(ArraySteps):
    """Compiled steps along functions that were sampled from several models."""

    definition: EnvironmentDefinition
    models: tuple[ArraySteps, ...]

    def __call__(
        self,
        q: Floats,
        u: Floats,
        *,
        noise: Floats | None,
        process: Floats | None,
        paths: Floats | None,
        stds: bool,
        reward_std: bool,
    ) -> ArrayTransition:
        assert paths is not None
        outputs = len(self.definition.outputs)
        all_ = ArrayTransition(np.empty_like(q), np.empty(len(q)), np.empty((len(q), outputs)), np.empty(len(q), bool))
        for index, rows in _members(torch.from_numpy(paths[:, 0]).long(), len(self.models)):
            which = rows.numpy()
            result = self.models[index](
                q[which],
                u[which],
                noise=None if noise is None else noise[which],
                process=None if process is None else process[which],
                paths=np.ascontiguousarray(paths[which, 1:]),
                stds=stds,
                reward_std=reward_std,
            )
            for whole, part in zip(vars(all_).values(), vars(result).values(), strict=True):
                whole[which] = part
        return all_


def _members(number: Tensor, count: int) -> list[tuple[int, Tensor]]:
    """Return a pair (index of a model, indices of its rows) for each model that has rows, or one model without any.
    ``number`` (m,) is the index of the model to which each row belongs; ``count`` is the number of models."""
    belongs = number == torch.arange(count, device=number.device)[:, None]
    (sizes,) = fetched(belongs.sum(1))  # the one wait for a device here
    rows = torch.split(number.argsort(stable=True), sizes.tolist())
    return [(index, which) for index, which in enumerate(rows) if len(which)] or [(0, rows[0])]


def _join(parts: Sequence[Tensor | None], order: Tensor) -> Tensor | None:
    tensors = [part for part in parts if part is not None]
    return torch.cat(tensors)[order] if tensors else None
