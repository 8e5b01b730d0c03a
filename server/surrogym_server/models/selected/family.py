"""SelectedFamilies: a family for each output, chosen by held-out steps, as a family for the registry of models."""

from __future__ import annotations

from dataclasses import dataclass, fields

from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.environment.samples import Samples
from surrogym_server.models.gaussian_process.settings import Settings
from surrogym_server.models.port import Learned, Learner, ModelCodec, Warm
from surrogym_server.models.selected.codec import SelectedCodec
from surrogym_server.models.selected.learning import learn
from surrogym_server.models.setting_checks import require_number
from surrogym_server.models.singles import BUILT_IN, ENSEMBLE, GAUSSIAN_PROCESS, SINGLES, SPARSE_GAUSSIAN_PROCESS
from surrogym_server.plugins import Choice

LARGEST_MARGIN = 10.0


@dataclass(frozen=True)
class SelectedFamilies(Settings, Learner):
    """Every candidate is fitted without some steps and predicts them; each output is served by the family that predicts
    it best. The settings of the built-in families are valid too, and are passed on to them. The warm start is those of
    the candidates, and which families have served and won: another family takes over only if it wins twice in a row.

    Attributes:
        candidates: names of families, with commas between them; the first one serves until another is better.
        margin: standard errors by which another family must be better.
    """

    candidates: str = f"{GAUSSIAN_PROCESS}, {SPARSE_GAUSSIAN_PROCESS}, {ENSEMBLE}"
    margin: float = 2.0
    inducing: int = 300
    members: int = 5
    units: int = 32
    steps: int = 600
    beta: float = 0.0
    networks: int = 4
    waves: int = 64
    iterations: int = 300
    seed: int = 0

    def __post_init__(self) -> None:
        super().__post_init__()
        names = self.names
        if not 2 <= len(set(names)) == len(names):
            raise ValueError(f"expected candidates to be at least two different families, got {self.candidates!r}")
        require_number("margin", self.margin, LARGEST_MARGIN)
        for name in names:
            self._learner(name)

    @property
    def names(self) -> tuple[str, ...]:
        """The candidates' names as they are registered, in order."""
        return tuple(SINGLES.name_of(name.strip()) for name in self.candidates.split(","))

    @property
    def learners(self) -> dict[str, Learner]:
        """The candidates, by name."""
        return {name: self._learner(name) for name in self.names}

    @property
    def codec(self) -> ModelCodec:
        return SelectedCodec(self.learners)

    def learn(self, definition: EnvironmentDefinition, samples: Samples, warm: Warm | None = None) -> Learned:
        return learn(self.learners, self.margin, definition, samples, warm or {})

    def _learner(self, name: str) -> Learner:
        """The candidate with those of its settings that this family has too."""
        kind = SINGLES.get(name)
        own = {field.name for field in fields(kind)} if name in BUILT_IN else set()  # type: ignore[arg-type]
        given = {field.name: getattr(self, field.name) for field in fields(self) if field.name in own}
        return SINGLES.make(Choice(name, tuple(given.items())))
