"""The stages of a training: the starts and lengths of their episodes, and the discount factor."""

from __future__ import annotations

from dataclasses import dataclass, replace

from surrogym_sampler.original.protocol import LONGEST_EPISODE
from surrogym_trainer.evaluation.imagined import DECLARED
from surrogym_trainer.training.derived_settings import suggested_gamma
from surrogym_trainer.training.search import SearchTask
from surrogym_trainer.training.settings import TrainSettings

SHORTER = 5  # in the stage ``learn``, an episode is shorter than the time limit by this factor
SHORTEST = 40  # in the stage ``learn``, an episode has at least this number of steps
SIGHT = 1 / 2  # in short episodes, the discount horizon 1 / (1 - gamma) is this share of the length of an episode


@dataclass(frozen=True)
class Stage:
    """One stage of a training by FastPpo: its name, the settings of its episodes and their discount factor."""

    name: str
    settings: TrainSettings  # settings of the stage's episodes
    gamma: float  # discount factor


def learn(task: SearchTask) -> Stage:
    """Return the stage of short episodes, half of which begin anywhere, with a discount horizon of half an episode.

    A model can start anywhere, which a machine can't. In short episodes each lane sees many states, including those
    near success, and a short horizon finds a first policy in a tenth of the steps. The last reward of a truncated
    episode includes the critic's value of its last state, so short episodes don't change what is optimal. Starts and
    lengths that the user chose are kept, and so are those of the preset ``paper``. The discount factor is then that of
    whole episodes.
    """
    spec, settings = task.port.spec(), task.settings
    ways = settings.start_box, settings.start_visited, settings.horizon
    chosen = any(way is not None for way in ways) or not {"time_limit", "start_box"}.isdisjoint(settings.session)
    if chosen or not spec.preset.adapts_training:
        return Stage("learn", settings, suggested_gamma(spec))
    limit = spec.time_limit or LONGEST_EPISODE
    length = min(max(limit // SHORTER, SHORTEST), limit)
    session = {**settings.session, "time_limit": length}
    short = replace(settings, session=session, judge=settings.judging)
    return Stage("learn", short, 1 - 1 / (SIGHT * length))


def refine(task: SearchTask) -> Stage:
    """Return the stage of whole episodes from the declared starts.

    Episodes that start anywhere can have returns a thousand times as large as those from the declared starts. Critic
    and advantages are then not precise enough for the declared starts.
    """
    settings = task.settings
    session = {**settings.session, **DECLARED}
    return Stage("refine", replace(settings, horizon=None, session=session), suggested_gamma(task.port.spec()))
