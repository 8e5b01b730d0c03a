"""An acquisition of one's own: the deviation, weighted by a bell around one value of one coordinate."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.sampling.acquisition import Acquisition, CandidateView


@dataclass(frozen=True)
class FocusedVariance(Acquisition):
    """Ask where the model is unsure, and rather where ``coordinate`` is near a value.

    Args:
        coordinate: name of a coordinate of the specification.
        near: where to ask, in the coordinate's unit.
        width: standard deviation of the bell, in the coordinate's unit.

    Raises:
        ValueError: a width that is not positive.
    """

    coordinate: str
    near: float = 0.0
    width: float = 1.0

    def __post_init__(self) -> None:
        if not self.width > 0:
            raise ValueError(f"expected a positive width, got {self.width}")

    def check(self, definition: EnvironmentDefinition) -> None:
        names = definition.coordinate_names
        if self.coordinate not in names:
            raise ValueError(f"expected coordinate to be one of {', '.join(names)}, got {self.coordinate!r}")

    def value(self, candidates: CandidateView) -> Tensor:
        column = candidates.model.definition.coordinate_names.index(self.coordinate)
        away = (candidates.points.q[:, column] - self.near) / self.width
        return candidates.std * (-0.5 * away.square()).exp()
