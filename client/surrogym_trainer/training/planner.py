"""Control without training: a planner on the surrogate's model in the place of a trained policy."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace

from surrogym_shared.port import ModelPort, SurrogatePort, horizon_of
from surrogym_shared.spec.base import MAX_INEQUALITIES, MOST_HORIZON
from surrogym_shared.surrogate_file import RealSamples, SurrogateFile
from surrogym_trainer.policies.card import UnusablePolicy
from surrogym_trainer.policies.planner_files import PlannerFile
from surrogym_trainer.training.checks import checked
from surrogym_trainer.training.search import Found, PolicySearch, SearchTask
from surrogym_trainer.training.settings import TrainProgress


@dataclass(frozen=True)
class Planner(PolicySearch):
    """A policy that plans each action by rollouts of the model. Nothing is trained."""

    horizon: int | None = None  # number of steps of each planned rollout; None: ``horizon_of`` the specification
    limits: Sequence[str] = ()  # limits that the plans keep, as ``surrogym_shared.limits.limit_of`` reads them

    suggested_steps = 1
    resumable = False  # it computes its values anew from the latest model

    def __post_init__(self) -> None:
        """Check the horizon, before the server's package is imported to plan."""
        if self.horizon is not None and not (type(self.horizon) is int and 1 <= self.horizon <= MOST_HORIZON):
            raise ValueError(
                f"algorithm PLANNER: horizon: expected a whole number of steps from 1 to {MOST_HORIZON}, got "
                f"{self.horizon!r}"
            )

    def search(self, task: SearchTask) -> Found:
        settings = task.settings
        if settings.integral:
            raise ValueError(
                "algorithm PLANNER: expected no integral, because a planner corrects lasting disturbances itself, got "
                f"{', '.join(settings.integral)}"
            )
        if isinstance(self.limits, str) or len(self.limits) > MAX_INEQUALITIES:
            raise ValueError(
                f"algorithm PLANNER: expected limits as a list of at most {MAX_INEQUALITIES} texts, got "
                f"{self.limits!r:.80}"
            )
        file, noise = _file_of(task.port).to_bytes(), dict(settings.session.get("sensor_noise", {}))
        limits, own = tuple(self.limits), horizon_of(task.port.spec()) if self.horizon is None else self.horizon
        planner = PlannerFile(file, own, settings.seed, settings.set_points, limits, noise)
        task.progress(
            TrainProgress(
                0, 0, None, 0.0, stage="computes values on a grid; the first process on a machine compiles for a minute"
            )
        )
        try:
            predict = planner.acting()
        except UnusablePolicy as error:
            raise ValueError(f"algorithm PLANNER: {error}") from error
        imagined, whole = None, True
        try:
            imagined = float(checked(task.port, predict, settings).mean())
            task.progress(TrainProgress(0, 0, imagined, 0.0, stage="computed values on a grid"))
        except KeyboardInterrupt:
            whole = False
        return Found(planner, 0, imagined, asdict(replace(self, horizon=own)), whole=whole)


def _file_of(port: SurrogatePort) -> SurrogateFile:
    """Return the surrogate as a file without samples, which a planner does not need."""
    if not isinstance(port, ModelPort):
        raise ValueError("algorithm PLANNER: expected a surrogate with a model, got an original environment")
    spec, model = port.spec(), port.model_file()
    return SurrogateFile("planner", spec, model, RealSamples.none(len(spec.coordinates), spec.action.size))
