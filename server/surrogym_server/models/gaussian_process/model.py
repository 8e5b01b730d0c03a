"""Model that consists of Gaussian processes fitted to one environment."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.environment.points import Points
from surrogym_server.environment.samples import Samples, increments
from surrogym_server.environment.step_rules import paid
from surrogym_server.gp import covariance
from surrogym_server.gp.thinning import thinned
from surrogym_server.models.abilities import (
    ArraySteps,
    AtSamples,
    CompiledSteps,
    FunctionDraws,
    GridPolicy,
    LearnedNoise,
    LeaveOneOut,
    LeaveOneOutErrors,
    Lookahead,
    OutputOutlook,
    PathOutlook,
    PlannedActions,
    PredictedSteps,
    RewardEdges,
    RewardPeaks,
    SampledFunctions,
    StepSource,
    UncertainHyperparameters,
    WrittenInC,
)
from surrogym_server.models.gaussian_process.censoring import usable
from surrogym_server.models.gaussian_process.prediction.description import describe, structure
from surrogym_server.models.gaussian_process.prediction.lookahead import (
    ProcessAlongPaths,
    ProcessOutlook,
    as_if_answered,
    process_inputs,
)
from surrogym_server.models.gaussian_process.prediction.output_model import OutputModel
from surrogym_server.models.gaussian_process.prediction.predictor import Predictor
from surrogym_server.models.gaussian_process.prediction.regions import Jump, Region
from surrogym_server.models.gaussian_process.prediction.several import FunctionsOfSeveral, uncertain_outputs
from surrogym_server.models.port import DynamicsModel, Transition
from surrogym_server.tensors import CPU, cached, to_device
from surrogym_shared import compiled

if TYPE_CHECKING:
    from surrogym_server.models.gaussian_process.prediction.compiled.step import StepsOfModel

Array = NDArray[np.float64]

# If a process has more points than this, standard deviations are computed faster by a linear algebra library than by
# compiled code.
COMPILED_SOLVES = 300


@dataclass(frozen=True)
class GaussianProcessModel(
    DynamicsModel,
    FunctionDraws,
    UncertainHyperparameters,
    LeaveOneOut,
    LearnedNoise,
    SampledFunctions,
    Lookahead,
    RewardEdges,
    RewardPeaks,
    CompiledSteps,
    PlannedActions,
    WrittenInC,
):
    """Model with one Gaussian process for each output. It can also contain learned regions of states: one in which
    episodes end, and others inside which the reward is higher or lower."""

    definition: EnvironmentDefinition
    transitions: tuple[OutputModel, ...]  # the M transition outputs, in the order of definition.outputs
    reward: OutputModel
    terminal_reward: float  # reward that steps that end an episode give in addition to the prediction of ``reward``
    samples: int
    digest: str
    ending: Region | None = None  # region in which episodes end, if termination is learned
    jumps: tuple[Jump, ...] = ()  # regions of states with the constants that are added to the reward inside them
    # Prior model, for example of a simulator. Its predictions are added to the outputs that have learned the difference
    # from it (those with a ``size_with_prior``).
    prior: GaussianProcessModel | None = None

    @property
    def outputs(self) -> tuple[OutputModel, ...]:
        """Models of all outputs, the reward last."""
        return (*self.transitions, self.reward)

    def transition(
        self,
        q: Tensor,
        u: Tensor,
        *,
        noise: Tensor | None = None,
        process: Tensor | None = None,
        stds: bool = False,
        reward_std: bool = False,
    ) -> Transition:
        return self._predictor.transition(q, u, noise, process, None, stds, reward_std)

    def means(self, q: Tensor, u: Tensor) -> Tensor:
        change, q_next, reward = self._predictor.means(q, u)
        reward = paid(self.terminal_reward, reward, self.terminated(q_next))
        return torch.cat([change, reward[:, None]], -1)

    def means_before_end(self, q: Tensor, u: Tensor) -> Tensor:
        """Return the predicted mean (m, O) of every output at q (m, C) and u (m, F), as ``means`` does, but without the
        terminal reward."""
        change, _, reward = self._predictor.means(q, u)
        return torch.cat([change, reward[:, None]], -1)

    def learned_termination(self, q: Tensor) -> Tensor:
        assert self.ending is not None
        return self.ending.probability(q)

    @cached
    def scales(self) -> Tensor:
        return torch.tensor([o.size for o in self.outputs], dtype=torch.float64, device=self.definition.device)

    @property
    def structures(self) -> tuple[str, ...]:
        return tuple(structure(output) for output in self.outputs)

    @property
    def description(self) -> dict[str, Any]:
        """Structure and hyperparameters of every output, for display."""
        outputs = [describe(self.definition, o) for o in self.outputs]
        if self.definition.declared_reward is not None:
            outputs[-1]["kernel"] = "declared"
        ending = {} if self.ending is None else {"termination": self.ending.description}
        jumps = [{"size": jump.size, **jump.region.description} for jump in self.jumps]
        beyond: dict[str, Any] = {"terminal_reward": self.terminal_reward, "jumps": jumps}
        if self.prior is not None:
            beyond["prior"] = {"samples": self.prior.samples, "digest": self.prior.digest}
        return {"outputs": outputs, **beyond, "samples": self.samples, **ending}

    @property
    def path_size(self) -> int:
        return self._predictor.path_size

    def draw(self, noise: Tensor) -> Tensor:
        return self._predictor.draw(noise)

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
        return self._predictor.transition(q, u, None, process, paths, stds, reward_std)

    @property
    def uncertain_functions(self) -> FunctionDraws:
        return self._uncertain_functions

    @property
    def noise_stds(self) -> tuple[float, ...]:
        return tuple(output.noise_std for output in self.outputs)

    @property
    def possible_noise(self) -> tuple[float, ...]:
        return tuple(output.possible_noise for output in self.outputs)

    def leave_one_out(self) -> tuple[LeaveOneOutErrors, ...]:
        return tuple(output.leave_one_out() for output in self.outputs)

    def at_samples(self, samples: Samples, column: int) -> AtSamples | None:
        output = self.transitions[column]
        if output.posterior is None:
            return None
        rows = self._learns(column, samples.q_next).nonzero()[:, 0]
        steps = PredictedSteps(samples.q[rows], samples.u[rows], samples.q_next[rows])
        x, hyper = process_inputs(self.definition, output, steps), output.posterior.hyper
        scale = output.scale * output.amplitude(x)
        targets = increments(self.definition, samples)[rows, column] - output.centre
        if self.prior is not None and output.size_with_prior is not None:
            targets = targets - self.prior.means_before_end(steps.q, steps.u)[:, column]
        function = scale[:, None] * covariance(hyper, x, x) * scale
        return AtSamples(rows, targets, function, float(scale.square().mean()) * hyper.noise_variance)

    def outlook(self, candidates: Points, reference: Points, assumed: Points) -> tuple[OutputOutlook | None, ...]:
        everywhere = Points.joined([candidates, reference, assumed])
        steps = PredictedSteps(everywhere.q, everywhere.u, self.transition(everywhere.q, everywhere.u).q_next)
        spans = (len(candidates), len(candidates) + len(reference))
        return tuple(
            None
            if output.posterior is None
            else ProcessOutlook.of(
                output, process_inputs(self.definition, output, steps), self._learns(column, steps.q_next), spans
            )
            for column, output in enumerate(self.outputs)
        )

    def along(self, steps: PredictedSteps, column: int) -> PathOutlook | None:
        output = self.outputs[column]
        if output.posterior is None:
            return None
        flat, shape = steps.flat, steps.q.shape[:-1]
        x = process_inputs(self.definition, output, flat)
        return ProcessAlongPaths(
            self.definition, output, x.reshape(*shape, -1), self._learns(column, flat.q_next).reshape(shape)
        )

    def as_if_answered(self, steps: PredictedSteps) -> GaussianProcessModel:
        outputs = [
            as_if_answered(output, process_inputs(self.definition, output, steps)[self._learns(column, steps.q_next)])
            for column, output in enumerate(self.outputs)
        ]
        return replace(self, transitions=tuple(outputs[:-1]), reward=outputs[-1])

    def reward_edge_doubts(self, q: Tensor, q_next: Tensor) -> Iterator[Tensor]:
        state = q_next if self.reward.feature_map.after else q
        for jump in self.jumps:
            inside = jump.region.probability(state)
            yield inside.minimum(1 - inside)

    @property
    def reward_hides(self) -> bool:
        return self.reward.warp is not None and self.reward.warp.sign > 0

    def promise(self, q: Tensor, u: Tensor) -> Tensor:
        """Return an optimistic score (m,) of the reward of each step from q (m, C) under u (m, F): the mean plus one
        standard deviation of the reward's process, which predicts the reward or its logarithm."""
        steps = PredictedSteps(q, u, self._predictor.transition(q, u, None, None, None, False, False).q_next)
        mean, std = self.reward.target(process_inputs(self.definition, self.reward, steps))
        return mean + std

    def compiled(self) -> ArraySteps | None:
        return self._compiled

    def compiled_pays(self, *, stds: bool) -> bool:
        outputs = (*self.outputs, *(() if self.prior is None else self.prior.outputs))
        points = max((len(o.posterior.x) for o in outputs if o.posterior is not None), default=0)
        return not stds or points <= COMPILED_SOLVES

    @property
    def plans(self) -> bool:
        return self._compiled is not None and (self.prior is None or self.prior.prior is None)

    def for_planning(self) -> GaussianProcessModel:
        outputs = [
            output if output.posterior is None else replace(output, posterior=thinned(output.posterior))
            for output in self.outputs
        ]
        prior = None if self.prior is None else self.prior.for_planning()
        return replace(self, transitions=tuple(outputs[:-1]), reward=outputs[-1], prior=prior)

    def planned(
        self,
        policy: GridPolicy,
        start: Array,
        offset: Array,
        early: NDArray[np.int64],
        late: bool,
        changes: Array,
        elite: int,
        best: Array,
    ) -> tuple[Array, Array]:
        from surrogym_server.models.gaussian_process.prediction.compiled.plan import plan

        steps, action, arrival = self._compiled, np.empty(changes.shape[3]), np.empty(len(start))
        assert steps is not None
        known = np.zeros((0, 0))
        if offset.any() and not self.definition.moves_observation:
            known = np.zeros((changes.shape[1], len(steps.uses)))
            known[:, : len(self.definition.moving)] = offset[list(self.definition.moving)]
        low, cell, count, cyclic = policy.grid
        prior, uses = (steps, np.zeros(0)) if steps.prior is None else (steps.prior, steps.uses)
        plan(
            *steps.tables,
            steps.has_regions,
            steps.outputs,
            *prior.tables,
            prior.has_regions,
            uses,
            self.terminal_reward,
            low,
            cell,
            count,
            cyclic,
            policy.values,
            policy.table,
            policy.discount,
            policy.choices,
            policy.least,
            policy.most,
            policy.avoided.numbers,
            policy.avoided.places,
            policy.avoided.price,
            start,
            known,
            early,
            late,
            changes,
            elite,
            best,
            action,
            arrival,
        )
        return action, arrival

    def step_source(self) -> StepSource | None:
        if self._compiled is None or self.prior is not None:
            return None
        from surrogym_server.models.gaussian_process.prediction.compiled.source import step_source
        from surrogym_server.models.gaussian_process.prediction.compiled.step import tables_of

        return step_source(self.definition, tables_of(self._predictor, self.ending))

    def _learns(self, column: int, q_next: Tensor) -> Tensor:
        """Return (m,) bool: for each of m steps to q_next (m, C), whether the output with index ``column`` would learn
        from it."""
        if column == len(self.transitions):
            return ~self.terminated(q_next)
        output = self.transitions[column]
        return usable(self.definition, column, q_next, output.feature_map, past_limits=output.past_limits)

    @cached_property
    def _compiled(self) -> StepsOfModel | None:
        if self.definition.device != CPU or not compiled.available():
            return None
        from surrogym_server.models.gaussian_process.prediction.compiled.step import StepsOfModel

        prior = None if self.prior is None else self.prior._compiled
        return StepsOfModel.of(self._predictor, self.ending, prior)

    @cached
    def _uncertain_functions(self) -> FunctionDraws:
        here = to_device(self, CPU)
        models = [
            to_device(replace(here, transitions=tuple(outputs[:-1]), reward=outputs[-1]), self.definition.device)
            for outputs in uncertain_outputs(here.outputs, repeatable=self.definition.max_rollout is None)
        ]
        return FunctionsOfSeveral(tuple(models)) if models else self

    @cached
    def _predictor(self) -> Predictor:
        prior = None if self.prior is None else self.prior._predictor
        return Predictor(self.definition, self.transitions, self.reward, self.jumps, prior)
