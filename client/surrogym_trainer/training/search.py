"""PolicySearch, the interface of policy searches, and the registry of the installed ones.

The laws of a search, which ``surrogym_trainer.testing`` checks:

1. The same surrogate, settings and seed give the same policy, bit for bit.
2. It takes at most ``task.steps`` virtual steps, rounded to whole units of its own work (a rollout, a generation), and
   at least one unit. Steps that only compare policies are not counted.
3. It reports progress with steps that never decrease and never exceed their total.
4. On Ctrl-C it returns the best policy so far, with ``whole=False``. It raises ``KeyboardInterrupt`` only if there is
   no policy yet. After an error of the surrogate it may do the same, with the error in ``stopped``.
5. It closes every session that it opens, also after errors. It writes no file; the policy's ``save`` does.
6. ``load_policy`` reads the saved policy without trust, and the policy gives actions of the surrogate's action space.
7. Impossible settings raise ``ValueError`` with what was expected and what came, before the first virtual step.
8. It starts from the policy of ``settings.start_from`` if that is set. A search that can't has ``resumable = False``.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any, ClassVar, Protocol, cast

from surrogym_shared.compiled import available
from surrogym_shared.network import Network
from surrogym_shared.plugins import Registry
from surrogym_shared.port import SurrogatePort
from surrogym_shared.spec import MOST_PLANNED, EnvironmentSpec
from surrogym_trainer.policies import load_policy
from surrogym_trainer.policies.predict import Predict
from surrogym_trainer.training.settings import TrainProgress, TrainSettings, prolongs

MAX_STEPS = 10_000_000  # largest number of virtual steps in a training, which takes PPO hours
ALGORITHMS = ("A2C", "DDPG", "DQN", "PPO", "SAC", "TD3")  # names of searches by Stable-Baselines3
FAST = "FASTPPO"  # name of the default search
REFERENCE = "PPO"  # name of the search by Stable-Baselines3's PPO
FAMILY = "gaussian_process"  # family of models on which planners act
PLANNING = "PLANNER"  # name of the search that makes a planner

Progress = Callable[[TrainProgress], None]


@dataclass(frozen=True)
class SearchTask:
    """What a policy search has to do: in which surrogate, with which settings, and within how many virtual steps."""

    port: SurrogatePort
    settings: TrainSettings
    steps: int  # largest number of virtual steps
    out: Path  # file to which the policy will be saved; also the name of the run in trackers
    prolong: bool = False  # whether to train in further cycles while the return rises, and then to refine the policy
    progress: Progress = lambda _: None


class Saved(Protocol):
    """A policy that can be saved: a ``Network`` of arrays, or a ``LearnedPolicy`` of Stable-Baselines3."""

    def save(self, path: Path) -> None:
        """Write a file that ``load_policy`` can read."""
        ...


@dataclass(frozen=True)
class Found:
    """The result of a policy search."""

    policy: Saved
    virtual_steps: int
    imagined_return: float | None  # imagined return of the policy; None if it was not measured
    settings: Mapping[str, Any] = field(default_factory=dict)  # settings of the search, including defaults
    algorithm: str | None = None  # class of Stable-Baselines3 that can read the file; None if the file needs none
    whole: bool = True  # whether the search finished; False after Ctrl-C or an error
    stopped: BaseException | None = None  # what ended the search: Ctrl-C or an error; ``train`` raises an error again
    episode_penalty: float | None = None
    lost_episodes: int = 0
    networks: int = 1
    gaining: bool = False
    untrained: float | None = None  # imagined return of an untrained network; None if not measured


class PolicySearch(ABC):
    """A method to find a policy. The constructor's arguments are the hyperparameters of the method.

    Examples:
        >>> @dataclass(frozen=True)
        ... class Guess(PolicySearch):
        ...     units: int = 8
        ...
        ...     def search(self, task):
        ...         spec = task.port.spec()
        ...         zeros, ones = np.zeros(len(spec.observation)), np.ones(len(spec.observation))
        ...         vector = np.random.default_rng(task.settings.seed).normal(size=Network.size(spec, self.units))
        ...         return Found(Network.of(spec, zeros, ones, self.units, vector), 0, None)
    """

    suggested_steps: ClassVar[int] = 600_000  # default number of virtual steps
    # largest number of virtual steps; None if there is no limit, because steps are cheap
    most_steps: ClassVar[int | None] = MAX_STEPS
    prolongable: ClassVar[bool] = False  # whether the search supports task.prolong
    whole_episodes: ClassVar[bool] = True  # whether episodes always start as declared and are never shortened
    tracked: ClassVar[bool] = False  # whether the search logs curves to settings.tracker
    saves_network: ClassVar[bool] = False  # whether policies are networks of arrays, which a sampler can run
    resumable: ClassVar[bool] = True  # whether the search can start from a saved policy, which the closed loop needs

    @abstractmethod
    def search(self, task: SearchTask) -> Found:
        """Find a policy within the task's number of virtual steps.

        The module docstring lists the laws that a search must keep.
        """

    def explorer(self, policy: Path, algorithm: str, num_envs: int) -> Predict:  # noqa: ARG002  for those that have noise
        """Load a saved policy that explores as in training; a policy without noise takes its most probable actions."""
        return load_policy(policy, algorithm)


SEARCHES = Registry[PolicySearch](
    "algorithm",
    "surrogym.policy_searches",
    PolicySearch,
    {
        **{name: f"surrogym_trainer.training.stable_baselines.algorithms:{name}" for name in ALGORITHMS},
        FAST: "surrogym_trainer.training.fast_ppo.search:FastPpo",
        "CMAES": "surrogym_trainer.training.cma_es:CmaEs",
        PLANNING: "surrogym_trainer.training.planner:Planner",
    },
)


def name_of(settings: TrainSettings) -> str:
    """Return the registered name of the search in the settings.

    Raises:
        ValueError: no search has this name.
    """
    return SEARCHES.name_of(settings.algorithm or FAST)


def with_algorithm(settings: TrainSettings, spec: EnvironmentSpec) -> TrainSettings:
    """Return the settings with the name of a search. If they name none, it is ``FAST`` (PPO in compiled code), or
    ``REFERENCE`` (PPO of Stable-Baselines3) if ``FAST`` does not support the settings, or ``PLANNING`` for a machine
    with a dead time (see ``_is_planned``).

    Only ``FAST`` needs numba. Only ``REFERENCE`` has trackers and some of the hyperparameters, and can continue a
    policy of Stable-Baselines3. ``REFERENCE`` is also the search of the preset ``paper``.
    """
    if settings.algorithm is not None:
        return settings
    if _is_planned(settings, spec):
        return replace(settings, algorithm=PLANNING)
    start, known = settings.start_from, {field.name for field in fields(cast("Any", SEARCHES.get(FAST)))}
    by_reference = (
        settings.tracker is not None
        or (start is None and not available())
        or not known.issuperset(settings.hyperparameters)
        or spec.preset.algorithm == REFERENCE
        or (start is not None and not Network.is_at(start))
    )
    return replace(settings, algorithm=REFERENCE if by_reference else FAST)


def _is_planned(settings: TrainSettings, spec: EnvironmentSpec) -> bool:
    """Whether a planner is the default: the environment can only be reset, and has so many coordinates because some
    repeat actions, through which a planner looks. Networks stay at a local optimum there, or need two to three times
    the real steps (decision 101). A setting that only a training has asks for a network."""
    of_planner = {field.name for field in fields(cast("Any", SEARCHES.get(PLANNING)))}
    plain = TrainSettings(
        seed=settings.seed,
        threads=settings.threads,
        session=settings.session,
        judge=settings.judge,
        hyperparameters={name: value for name, value in settings.hyperparameters.items() if name in of_planner},
    )
    return (
        spec.access == "reset"
        and spec.fits_planner
        and len(spec.coordinates) > MOST_PLANNED
        and spec.design.model in (None, FAMILY)
        and settings == plain
        and find_spec("surrogym_server") is not None
    )


def search_for(settings: TrainSettings) -> PolicySearch:
    """Return the search that the settings name, with its hyperparameters.

    Raises:
        ValueError: the settings name no search, the name or a hyperparameter is unknown, or the search does not support
            a setting: prolonging, tracking, a policy to start from, other starts, or a horizon.
    """
    name, kind = name_of(settings), SEARCHES.get(name_of(settings))
    if settings.prolong and not kind.prolongable:
        raise ValueError(
            f"algorithm {name} trains for a fixed number of steps, which can't be prolonged: train without prolong, or "
            "with another algorithm"
        )
    if kind.whole_episodes and (settings.start_visited is not None or settings.horizon is not None):
        raise ValueError(
            f"algorithm {name} runs whole episodes from the starts of the specification: leave start_visited and "
            "horizon "
            "out, or use another algorithm"
        )
    if settings.tracker is not None and not kind.tracked:
        raise ValueError(
            f"algorithm {name} reports to no tracker: leave {settings.tracker} out, or use another algorithm"
        )
    if settings.start_from is not None and not kind.resumable:
        raise ValueError(
            f"algorithm {name} always begins with a new network: leave the policy to start from out, or use another "
            "algorithm"
        )
    try:
        return kind(**settings.hyperparameters)
    except TypeError as error:
        known = ", ".join(getattr(kind, "__dataclass_fields__", ())) or "other hyperparameters"
        raise ValueError(
            f"algorithm {name}: expected some of the hyperparameters {known}, got {', '.join(settings.hyperparameters)}"
        ) from error


def planned_steps(settings: TrainSettings) -> int:
    """Return the planned number of virtual steps of a training.

    Raises:
        ValueError: the steps exceed the maximum, or the algorithm is unknown.
    """
    kind = SEARCHES.get(name_of(settings))
    total = kind.suggested_steps if settings.total_steps is None else settings.total_steps
    if total < 1 or (kind.most_steps is not None and total > kind.most_steps):
        raise ValueError(
            f"virtual steps: expected {f'1 to {kind.most_steps}' if kind.most_steps else '1 or more'}, got {total}"
        )
    return total


def is_prolonged(settings: TrainSettings, spec: EnvironmentSpec) -> bool:
    """Return whether a training takes more cycles while its return rises, and refines its policy.

    Raises:
        ValueError: the settings don't fit the search.
    """
    return search_for(settings).prolongable and prolongs(settings, spec)
