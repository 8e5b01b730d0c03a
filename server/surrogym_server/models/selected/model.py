"""SelectedModel: the outputs of one environment, each predicted by the model of one family."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, cast

import torch
from torch import Tensor

from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.environment.step_rules import paid, settle, with_lags
from surrogym_server.models.abilities import FunctionDraws, RewardOfStep
from surrogym_server.models.draws import function_draws
from surrogym_server.models.port import A, DynamicsModel, Transition
from surrogym_server.models.selected.abilities import ability_of
from surrogym_server.models.selected.selection import Selection
from surrogym_server.tensors import cached


@dataclass(frozen=True)
class SelectedModel(DynamicsModel):
    """Models of some families, the parts, all of the same samples. If one family serves every output, it is that
    family's model.

    A part predicts from its own view of the outputs that others serve: an output that depends on the predicted change
    of another reads its own part's prediction of it. The reward and a learned end belong to one part. If that part can,
    it judges the next state that all parts have predicted together.
    """

    definition: EnvironmentDefinition
    parts: tuple[DynamicsModel, ...]
    serving: tuple[int, ...]  # part of each output (O,)
    selection: Selection
    terminal_reward: float
    samples: int
    digest: str

    @classmethod
    def of(
        cls, definition: EnvironmentDefinition, models: dict[str, DynamicsModel], selection: Selection
    ) -> SelectedModel:
        """Compose the models of families by name. Those that serve nothing are left out."""
        names = tuple(dict.fromkeys(selection.serving))
        parts, serving = tuple(models[name] for name in names), tuple(map(names.index, selection.serving))
        paying = parts[serving[-1]]
        return cls(definition, parts, serving, selection, paying.terminal_reward, paying.samples, paying.digest)

    def transition(
        self,
        q: Tensor,
        u: Tensor,
        *,
        noise: Tensor | None = None,
        process: Tensor | None = None,
        deviations: bool = False,
        reward_deviation: bool = False,
    ) -> Transition:
        made = [
            part.transition(
                q, u, noise=noise, process=process, deviations=deviations, reward_deviation=reward_deviation
            )
            for part in self.parts
        ]
        return self.joined(made, q, u, reward_deviation=reward_deviation)

    def joined(
        self,
        made: Sequence[Transition],
        q: Tensor,
        u: Tensor,
        *,
        reward_deviation: bool,
        draws: FunctionDraws | None = None,
        paths: Tensor | None = None,
    ) -> Transition:
        """Join what each part has predicted from q (m, C) under u (m, F). With ``draws``, the reward's part has
        predicted along its functions ``paths`` (m, W)."""
        if len(self.parts) == 1:
            return made[0]
        arrived = torch.stack([made[part].q_next[:, i] for i, part in enumerate(self._coordinates)], 1)
        q_next = with_lags(self.definition, q, u, settle(self.definition, arrived))
        *moves, paying = self.serving
        spread = None
        if made[0].deviation is not None:
            columns = [cast(Tensor, made[part].deviation)[:, i] for i, part in enumerate(moves)]
            spread = torch.stack(columns, 1) if columns else made[0].deviation
        reward, doubt = made[paying].reward, made[paying].reward_deviation
        able = self.parts[paying].ability(RewardOfStep) if draws is None else draws
        if (known := self.definition.declared_reward) is not None:
            reward = known(q_next if known.after else q, u)
        elif isinstance(able, RewardOfStep):
            reward, doubt = able.reward_of_step(q, u, q_next, paths=paths, deviation=reward_deviation)
        return Transition(q_next, reward, spread, doubt)

    def means(self, q: Tensor, u: Tensor) -> Tensor:
        if len(self.parts) == 1:
            return self.parts[0].means(q, u)
        means = [part.means(q, u) for part in self.parts]
        made = self.transition(q, u)
        reward = paid(self.terminal_reward, made.reward, self.terminated(made.q_next))
        return torch.stack([*(means[part][:, i] for i, part in enumerate(self.serving[:-1])), reward], 1)

    def learned_termination(self, q: Tensor) -> Tensor:
        """As the reward's family predicts it."""
        return self.parts[self.serving[-1]].learned_termination(q)

    @cached
    def scales(self) -> Tensor:
        return torch.stack([self.parts[part].scales[i] for i, part in enumerate(self.serving)])

    @property
    def structures(self) -> tuple[str, ...]:
        return tuple(self.parts[part].structures[i] for i, part in enumerate(self.serving))

    @property
    def description(self) -> dict[str, Any]:
        """The part's description of each output, with the name of its family, and the selection."""
        described = [part.description for part in self.parts]
        outputs = [
            {**described[part]["outputs"][i], "family": self.selection.serving[i]}
            for i, part in enumerate(self.serving)
        ]
        return {**described[self.serving[-1]], "outputs": outputs, "selection": self.selection.to_json()}

    def ability(self, kind: type[A]) -> A | None:
        if len(self.parts) == 1:
            return self.parts[0].ability(kind)
        return cast("A | None", ability_of(self, kind))

    def with_parts(self, parts: Sequence[DynamicsModel]) -> SelectedModel:
        """The same model with other parts, in the same order."""
        return replace(self, parts=tuple(parts))

    @cached_property
    def functions(self) -> tuple[FunctionDraws, ...]:
        """What draws functions of each part."""
        return tuple(map(function_draws, self.parts))

    def on(self, device: torch.device) -> SelectedModel:
        if device == self.definition.device:
            return self
        moved = self.with_parts([part.on(device) for part in self.parts])
        return replace(moved, definition=self.definition.on(device))

    @cached_property
    def _coordinates(self) -> tuple[int, ...]:
        """Part of each coordinate (C,): that of its output. Others come from the first one; they follow from the
        step."""
        found = dict(zip(self.definition.moving, self.serving, strict=False))
        return tuple(found.get(i, 0) for i in range(len(self.definition.coordinates)))
