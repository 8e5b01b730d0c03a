"""Models of several families without a comparison."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.environment.samples import Samples
from surrogym_server.models.port import Learned, Learner, ModelCodec, Warm
from surrogym_server.models.selected import SelectedFamilies
from surrogym_server.models.selected.model import SelectedModel
from surrogym_server.models.selected.selection import Evidence, Selection
from surrogym_server.testing import ModelCase, model_cases


@dataclass(frozen=True)
class Mixed(Learner):
    """A family ``selected`` whose outputs are served by the candidates that a test names."""

    family: SelectedFamilies
    serving: tuple[str, ...]  # of each output (O,)

    @property
    def codec(self) -> ModelCodec:
        return self.family.codec

    def learn(self, definition: EnvironmentDefinition, samples: Samples, warm: Warm | None = None) -> Learned:
        del warm
        learners = self.family.learners
        models = {name: learners[name].learn(definition, samples).model for name in set(self.serving)}
        selection = Selection(tuple(learners), self.serving, Evidence("none"), ((),) * len(self.serving))
        return Learned(SelectedModel.of(definition, models, selection), {})


@dataclass(frozen=True)
class MixedCase(ModelCase):
    serving: tuple[str, ...] = ()

    @property
    def learner(self) -> Learner:
        family = super().learner
        assert isinstance(family, SelectedFamilies)
        return Mixed(family, self.serving)


def mixed_cases(
    serving: Sequence[str], settings: Mapping[str, float | bool | str] | None = None
) -> tuple[MixedCase, ...]:
    """The cases of ``selected``, with these families for the angle, the speed and the reward."""
    return tuple(
        MixedCase(case.name, case.definition, case.count, tuple(serving)) for case in model_cases("selected", settings)
    )
