"""A simulator as the prior (a model of what is known beforehand) of a design in this process."""

from __future__ import annotations

import os
from typing import Any

import numpy as np
import torch
from torch import Tensor

from surrogym.design import Design
from surrogym_sampler.original.errors import StepRefused
from surrogym_sampler.priors.prior import Careful, Progress, SimulatorPrior
from surrogym_server.convert import definition_from_spec
from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.errors import InvalidInput, PluginFailed
from surrogym_server.local import LocalSurrogate
from surrogym_server.models.port import DynamicsModel, Transition
from surrogym_shared.surrogate_file import SurrogateFile

MOST_THREADS = 4
DIVERGED = 1e15  # a step to larger numbers counts as diverged; policies can't take them


class Prior(SimulatorPrior):
    """Prior of a design: a model of a simulator, which is learned in this process. Arguments and errors are those of
    ``SimulatorPrior``.

    Examples:
        >>> prior = surrogym.Prior("textbook:Arm", spec, ["mass=0.5..2", "length"])
        >>> design = surrogym.Design(spec, budget=40, prior=prior)
    """

    def learn(self, say: Progress) -> tuple[SurrogateFile, float]:
        design, simulator = Design(self.spec, threads=min(MOST_THREADS, os.cpu_count() or 1)), Careful(self.simulator)
        while (query := design.ask()) is not None:
            try:
                design.tell(query, simulator.step_from(np.array(query.coordinates), np.array(query.action)))
            except StepRefused:
                design.give_up(query)
            say(0.5 * design.steps / self.steps, f"{design.steps} of {self.steps} steps of the simulator")
        return design.to_file("prior"), design.fidelity["confidence_index"]

    def stepped(self) -> LocalSurrogate:
        """Return a surrogate whose steps are those of the simulator itself, with its calibrated parameters, to train a
        policy in. It learns nothing of what the simulator lacks. Use it where a model of the simulator can't be learned
        from some hundreds of steps, as with contacts.

        Raises:
            InvalidInput: the specification leaves the termination to be learned, or the reward of a simulator that has
                none.
        """
        if self.spec.termination == "learned":
            raise InvalidInput(
                "expected a declared termination, because a simulator can't be asked for one: declare it"
            )
        if self.spec.reward.kind != "declared" and not self.pays:
            raise InvalidInput(f"expected a declared reward, because {self.source} has none: declare it")
        return LocalSurrogate(self.spec, SteppedModel(definition_from_spec(self.spec), self.simulator))


class SteppedModel(DynamicsModel):
    """A simulator in the place of a model of it. Its steps are certain. A step raises ``PluginFailed`` if the simulator
    raises an error or diverges."""

    samples, digest = 1, "stepped"

    def __init__(self, definition: EnvironmentDefinition, simulator: Any) -> None:
        self.definition, self._simulator = definition, simulator
        self._many = getattr(simulator, "steps_from", None) if definition.declared_reward else None
        self.terminal_reward = definition.declared_reward.terminal if definition.declared_reward else 0.0

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
        del noise, process  # the simulator is certain, and has no noise
        try:
            q_next, reward = self._taken(q, u)
        except (Exception, SystemExit) as error:  # a user's code may raise anything
            raise PluginFailed(
                f"the simulator failed: {type(error).__name__}: {error}; correct the simulator"
            ) from error
        if not all((numbers.abs() < DIVERGED).all() for numbers in (q_next, reward)):  # not so for NaN either
            raise PluginFailed(
                f"expected numbers below {DIVERGED:g} from the simulator, got larger ones or NaN: give it a smaller "
                "time step, or narrow the sampling ranges and starts"
            )
        if (declared := self.definition.declared_reward) is not None:
            reward = declared(q_next if declared.after else q, u)
        certain = q.new_zeros(len(q), len(self.definition.outputs))
        return Transition(q_next, reward, certain[:, :-1] if stds else None, certain[:, -1] if reward_std else None)

    def _taken(self, q: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
        if self._many is not None:
            return torch.from_numpy(self._many(q.numpy(), u.numpy())), q.new_zeros(len(q))
        steps = [self._simulator.step_from(*row) for row in zip(q.numpy(), u.numpy(), strict=True)]
        q_next = q.new_tensor(np.array([step.next_coordinates for step in steps]))
        return q_next, q.new_tensor([step.reward for step in steps])

    def means(self, q: Tensor, u: Tensor) -> Tensor:
        moved = self.transition(q, u)
        return torch.cat([(moved.q_next - q)[:, list(self.definition.moving)], moved.reward[:, None]], -1)

    def learned_termination(self, q: Tensor) -> Tensor:
        raise NotImplementedError

    @property
    def scales(self) -> Tensor:
        return torch.ones(len(self.definition.outputs), dtype=torch.float64)

    @property
    def structures(self) -> tuple[str, ...]:
        return ("simulator",) * len(self.definition.outputs)

    @property
    def description(self) -> dict[str, Any]:
        return {"outputs": [{"name": name} for name in self.definition.outputs]}
