"""Settings, progress and result of a training, which are common to all policy searches. Some settings follow from a
specification, or from other settings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from surrogym_shared.spec import EnvironmentSpec
from surrogym_shared.wire import OF_PARTICLES, SurrogateView

CHECKS = 12  # number of checks of the imagined return in one training; the best policy is kept
CHECK_EPISODES = 64
# Default largest number of virtual steps, for all rounds of training together; the paper's maximum.
SUGGESTED_STEPS = 1_000_000
# session options with which each step is a draw from the model's prediction
DRAWS: dict[str, Any] = {"variant": "probabilistic", "particles": 1, "spread": 0.0}
# session options with which each episode follows one sampled function
FUNCTIONS: dict[str, Any] = {"variant": "pathwise"}

START_BOX = 0.5  # default share of episodes that start anywhere in the sampling range

MOST_THREADS = 1_024  # largest number of threads that may be set, because torch would end the process with too many

TENSORBOARD = "tensorboard"  # name of the default folder of TensorBoard's files, beside the policy

Tracker = Literal["tensorboard", "wandb", "mlflow"]


@dataclass(frozen=True)
class TrainSettings:
    """Settings of a training. A setting that is None has a default, which the specification or the policy search
    determines.

    ``session`` has further fields of ``OpenSession`` (variant, particles, model, penalty, ...). ``hyperparameters`` are
    passed to the algorithm's constructor and replace its defaults.

    Raises:
        ValueError: ``threads`` is not an integer from 1 to ``MOST_THREADS``.
    """

    algorithm: str | None = None  # name of a PolicySearch, in upper or lower case; None lets ``with_algorithm`` choose
    total_steps: int | None = None
    num_envs: int | None = None
    seed: int = 0
    start_box: float | None = None  # share of episodes that start anywhere in the sampling range; None takes START_BOX
    start_visited: float | None = None  # share of episodes that start at a state of a real step; None takes 0
    horizon: int | None = None  # longest training episode, in steps; None takes the time limit
    start_from: Path | None = None  # saved policy to continue from
    trust_policy: bool = False  # whether to unpickle the objects of the policy in ``start_from``, which may run code
    anew: bool = False  # whether to begin with a new network, and use the saved policy only if the new one stays worse
    # whether to train in further cycles while the return rises, and then to refine the policy; None lets the function
    # ``prolongs`` decide
    prolong: bool | None = None
    threads: int = 1
    tracker: Tracker | None = None  # tracker of curves, for searches that log them
    # folder of TensorBoard's files; None takes one beside the policy, if the tracker has such files
    tensorboard: Path | None = None
    session: dict[str, Any] = field(default_factory=dict)
    # session fields of the episodes that compare policies; None takes those of the training
    judge: dict[str, Any] | None = None
    hyperparameters: dict[str, Any] = field(default_factory=dict)
    # coordinates whose errors from their set points the policy also sees, summed over the episode (see ``Integrals``)
    integral: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if type(self.threads) is not int or not 1 <= self.threads <= MOST_THREADS:
            raise ValueError(f"threads: expected a whole number from 1 to {MOST_THREADS}, got {self.threads!r}")

    @property
    def learning(self) -> dict[str, Any]:
        """The fields of ``OpenSession`` for the session in which a policy learns. By default, a share of the episodes
        starts anywhere in the sampling range, or none if some episodes start at the states of real steps."""
        usual = START_BOX if self.start_visited is None else 0.0
        fields: dict[str, Any] = {"seed": self.seed, "start_box": usual if self.start_box is None else self.start_box}
        if self.start_visited is not None:
            fields["start_visited"] = self.start_visited
        if self.horizon is not None:
            fields["time_limit"] = self.horizon
        return {**fields, **self.session}

    @property
    def set_points(self) -> dict[str, float]:
        """Set points that replace those of the declared reward, by coordinate."""
        return dict(self.session.get("set_points", {}))

    @property
    def judging(self) -> dict[str, Any]:
        return self.session if self.judge is None else self.judge


def chosen_for(view: SurrogateView, settings: TrainSettings) -> TrainSettings:
    """Return settings adapted to the phase in which the surrogate's design ended.

    - If the design has confirmed noise, the learned noise is added to the state. Noise of the sensors is added to
      observations instead.
    - If the design is not ready, each step of a lane is a new draw from the model's prediction (TS1 of Chua et al.
      2018), because a policy that relies on an uncertain mean fails in the original environment. Policies are then
      compared along drawn functions of the posterior: independent draws would shake a lane out of a state in which the
      policy would remain.
    - If the specification penalises leaving the states of a log, no episode starts outside of them.
    - A variant in ``settings`` is kept. With preset ``paper``, ``settings`` itself is returned.

    Args:
        view: the surrogate.
        settings: settings that the user chose.
    """
    if not view.spec.preset.adapts_training:
        return settings
    if view.spec.outside_reward is not None and settings.start_box is None:
        settings = replace(settings, start_box=0.0)
    if noise_of(view):
        settings = replace(settings, session={**noise_of(view), **settings.session})
    if "variant" in settings.session or view.phase == "ready":
        return settings
    other = {name: value for name, value in settings.session.items() if name not in OF_PARTICLES}
    return replace(settings, session=DRAWS | settings.session, judge=FUNCTIONS | other)


def noise_of(view: SurrogateView) -> dict[str, Any]:
    """Return the session fields that add the noise which the design has confirmed; empty if there is none."""
    outputs = [] if view.fidelity is None else view.fidelity.outputs
    sensors = {output.name: output.sensor_noise for output in outputs if output.sensor_noise > 0}
    fields: dict[str, Any] = {"process_noise": True} if any(output.noise > 0 for output in outputs) else {}
    return fields | ({"sensor_noise": sensors} if sensors else {})


def prolongs(settings: TrainSettings, spec: EnvironmentSpec) -> bool:
    """Return whether a training takes more cycles while its return rises, and refines its policy.

    The setting ``prolong`` decides. If it is None, the training does so if the user chose no number of steps and the
    preset is not ``paper``.
    """
    if settings.prolong is not None:
        return settings.prolong
    return settings.total_steps is None and spec.preset.adapts_training


def with_folder(settings: TrainSettings, out: Path) -> TrainSettings:
    """Return the settings with the folder for TensorBoard's files, if the tracker has such files. The default is beside
    the policy."""
    if settings.tensorboard is not None or settings.tracker not in ("tensorboard", "wandb"):
        return settings
    return replace(settings, tensorboard=out.parent / TENSORBOARD)


@dataclass(frozen=True)
class TrainProgress:
    """The state of a training at one report."""

    steps: int
    total_steps: int  # 0 if the search takes no virtual steps, as a planner
    # imagined return at the last check: mean return of virtual episodes from the declared starts
    imagined_return: float | None
    # Sum of the penalties for uncertainty since the last report, as a share of the sum of absolute rewards.
    penalty_share: float
    # Mean penalty for uncertainty in the last 100 training episodes; None without it.
    episode_penalty: float | None = None
    # confidence index over the states that the policy visited in the last round of training
    visited_confidence: float | None = None
    stage: str | None = None  # name of the current stage, if the search has stages


@dataclass(frozen=True)
class TrainResult:
    """The result of a training."""

    path: Path
    algorithm: str
    virtual_steps: int
    seconds: float
    imagined_return: float | None  # imagined return of the saved policy
    lost_episodes: int  # number of episodes that ended because the server lost the session
    settings: dict[str, Any]
    # Mean penalty for uncertainty in the last 100 training episodes; None without it.
    episode_penalty: float | None = None
    networks: int = 1  # number of networks that the last training began; above 1 if some learned nothing
    gaining: bool = False  # whether the best policy was still improving when the training ended
    untrained: float | None = None  # imagined return of an untrained network; None if not measured
    # For each round of training, the confidence index over the states that its policy visited.
    visited_confidence: tuple[float | None, ...] = ()


def summed(result: TrainResult, trainings: Sequence[TrainResult]) -> TrainResult:
    """Return a result with the virtual steps, the seconds and the lost episodes of all ``trainings``."""
    return replace(
        result,
        virtual_steps=sum(one.virtual_steps for one in trainings),
        seconds=sum(one.seconds for one in trainings),
        lost_episodes=sum(one.lost_episodes for one in trainings),
    )


class TrainingInterrupted(KeyboardInterrupt):
    """Ctrl-C interrupted a training; ``result`` is that of the best policy so far, which was saved."""

    def __init__(self, result: TrainResult) -> None:
        super().__init__()
        self.result = result


BATCH = 1_024  # suggested size of a batch; large, because the time of an update depends mostly on the number of batches
SHORTEST_SIGHT, LONGEST_SIGHT = 0.9, 0.999  # smallest and largest suggested discount factor


def suggested_gamma(spec: EnvironmentSpec) -> float:
    """Return the discount factor whose horizon, 1 / (1 - gamma), is a third of the time limit: 0.985 for 200 steps,
    0.994 for 500."""
    return min(max(1 - 3 / (spec.time_limit or 1_000), SHORTEST_SIGHT), LONGEST_SIGHT)


def even_batch(rollout: int) -> int:
    """Return a batch size near 1,024 that divides the number of steps in a rollout; the whole rollout if it
    is smaller."""
    return next(rollout // k for k in range(max(rollout // BATCH, 1), rollout + 1) if rollout % k == 0)


class ProgressEstimate:
    """The share of a training that is done.

    A training may be extended: by a round, after an audit, or because it still gains. The part that is not done then
    stands for all steps that are left, so that the share never falls.
    """

    def __init__(self) -> None:
        # share of the training that is done: now, and when the total number of steps last changed
        self._share = self._base = 0.0
        self._steps = self._begun = 0  # virtual steps taken: now, and when the total number of steps last changed
        self._total = 0
        # virtual steps and seconds at the first call of words_of_time_left
        self._first: tuple[int, float] | None = None

    def share(self, steps: int, total: int) -> float:
        """Return the share that is done, in [0, 1], after ``steps`` of ``total`` virtual steps."""
        if total != self._total:
            self._begun, self._base, self._total = self._steps, self._share, total
        self._steps = max(self._steps, steps)
        left = max(total - self._begun, 1)
        done = self._base + (1 - self._base) * min((self._steps - self._begun) / left, 1.0)
        self._share = max(self._share, done)
        return self._share

    def words_of_time_left(self, steps: int, total: int, seconds: float) -> str:
        """Return in words an estimate of how long a training of ``total`` virtual steps still takes.

        The pace is measured since the first call, because work before the first steps, such as compiling, happens only
        once. So the first call gives no estimate, which is an empty text. The estimate ends with a comma, because it
        stands before other words, which a narrow terminal cuts off.

        Args:
            steps: virtual steps taken.
            total: virtual steps of the whole training, as far as is known.
            seconds: duration so far.
        """
        before, began = self._first = self._first or (steps, seconds)
        if steps <= before or seconds <= began or steps >= total:
            return ""
        left = (total - steps) * (seconds - began) / (steps - before)
        return f"about {f'{left:.0f} s' if left < 90 else f'{left / 60:.0f} min'} left, "


def after(now: TrainProgress, done: int, total: int = 0) -> TrainProgress:
    """Return the progress ``now`` of a training, with the ``done`` virtual steps of earlier trainings added to its
    steps and to its total. The total is at least ``total``."""
    return replace(now, steps=done + now.steps, total_steps=max(total, done + now.total_steps))
