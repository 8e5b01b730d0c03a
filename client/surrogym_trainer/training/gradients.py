"""Policy search by gradients through the model's mean step. It needs the extra ``server``.

The search itself is in the server's package, because it needs the model and not a session. This module fetches the
model and adapts the search to the port ``PolicySearch``.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from importlib.metadata import entry_points
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from surrogym_client.environments import open_file
from surrogym_client.surrogates.transfer import export_surrogate
from surrogym_client.transport import Api, HttpSurrogate
from surrogym_sampler.original.protocol import LONGEST_EPISODE
from surrogym_shared.port import SurrogatePort
from surrogym_trainer.training.search import Found, PolicySearch, SearchTask
from surrogym_trainer.training.settings import DRAWS, FUNCTIONS, TrainProgress

ENTRY_POINTS = "surrogym.gradients"  # entry point of the server's package


@dataclass(frozen=True)
class Gradients(PolicySearch):
    """Policy search that follows the gradient of the imagined return. For continuous actions only.

    The model moves by its mean, whatever the session's variant. Other models than the latest, a penalty, a trust region
    and a policy to start from are refused.
    """

    lanes: int = 128
    horizon: int | None = None  # steps of an episode to differentiate; None: a third of the time limit, 50 to 100
    units: int = 64
    learning_rate: float = 0.05
    largest_norm: float = 1.0

    suggested_steps = 1_843_200  # 200 updates on Pendulum
    resumable = False
    by_mean = True

    def search(self, task: SearchTask) -> Found:
        _require_plain(task)
        library = _library()
        library.torch.set_num_threads(task.settings.threads)  # many small products: threads cost more than they give
        surrogate = _with_model(task.port)
        settings = self._settings(library, task)

        def look(now: Any) -> None:
            steps = now.number * task.steps // settings.updates
            task.progress(TrainProgress(steps, task.steps, now.imagined_return, 0.0))

        try:
            found = library.optimise(surrogate, settings, look)
        except library.InvalidInput as error:
            raise ValueError(str(error)) from error
        ran_with = {**asdict(settings), "total_steps": task.steps}
        return Found(found.policy, found.virtual_steps, found.imagined_return, ran_with, whole=found.whole)

    def _settings(self, library: Any, task: SearchTask) -> Any:
        """Return settings with as many updates as the steps of the task allow. The steps of checks are subtracted
        first."""
        limit = task.port.spec().time_limit or LONGEST_EPISODE
        third = min(max(limit // 3, library.SHORTEST_HORIZON), library.LONGEST_HORIZON)
        horizon = min(self.horizon or third, limit)
        left = task.steps - library.CHECKS * library.CHECK_LANES * limit
        updates = max(left // (self.lanes * horizon), 1)
        chosen = {**asdict(self), "horizon": horizon, "updates": updates, "seed": task.settings.seed}
        return library.GradientSettings(**chosen)


def _require_plain(task: SearchTask) -> None:
    """Refuse settings that have no meaning for the mean of the latest model."""
    if others := sorted({*task.settings.session} - {*DRAWS, *FUNCTIONS}):
        raise ValueError(f"gradients use the mean of the latest model: expected no session options, got {others}")


def _library() -> Any:
    """Return the module of the server's package that contains the search by gradients.

    Raises:
        ModuleNotFoundError: the extra ``server`` is not installed.
    """
    (entry,) = entry_points(group=ENTRY_POINTS, name="gradients")
    return entry.load()


def _with_model(port: SurrogatePort) -> Any:
    """Return a surrogate whose model is in this process. The model is fetched from the server if necessary."""
    if not isinstance(port, HttpSurrogate):
        if hasattr(port, "model"):
            return port
        raise ValueError(f"gradients need the model: expected a surrogate of a server or a file, got {port!r}")
    with TemporaryDirectory() as folder:
        path = Path(folder) / "model.surrogate"
        path.write_bytes(export_surrogate(Api.over(port.connection), port.surrogate).to_bytes())
        return open_file(path)
