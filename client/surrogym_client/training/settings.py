"""What every policy search is asked, tells while it runs, and gives back."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from surrogym_shared.spec import EnvironmentSpec
from surrogym_shared.wire import OF_PARTICLES, SurrogateView

CHECKS = 12  # of the imagined return in one training; the best policy is kept
CHECK_EPISODES = 64
SUGGESTED_STEPS = 1_000_000  # virtual ones, the most that is suggested for all rounds together; the paper's cap
DRAWS: dict[str, Any] = {"variant": "probabilistic", "particles": 1, "spread": 0.0}  # each step of a lane is a draw
FUNCTIONS: dict[str, Any] = {"variant": "pathwise"}  # each episode follows one function

START_BOX = 0.5  # usually

MOST_THREADS = 1_024  # more than any machine has; torch would end the process when the system refuses another thread

TENSORBOARD = "tensorboard"  # folder beside the policy

Tracker = Literal["tensorboard", "wandb", "mlflow"]


@dataclass(frozen=True)
class TrainSettings:
    """What to train. None takes what the specification suggests.

    ``session`` holds further fields of ``OpenSession`` (variant, particles, model, penalty, ...); ``hyperparameters``
    go to the algorithm's constructor, over the defaults. Raises ValueError for ``threads`` that no machine has.
    """

    algorithm: str = "PPO"  # name of a ``PolicySearch``, in any case
    total_steps: int | None = None
    num_envs: int | None = None
    seed: int = 0
    start_box: float | None = None  # share of episodes that start anywhere in the sampling range; None: START_BOX
    start_from: Path | None = None  # go on from a saved policy
    trust_policy: bool = False  # unpickle that policy's objects, which may run code
    anew: bool = False  # begin with a new network, and go on from the saved policy only where that falls short
    prolong: bool | None = None  # as many steps again while it still gains; None: as ``prolongs``
    threads: int = 1
    tracker: Tracker | None = None  # of the searches that log curves
    tensorboard: Path | None = (
        None  # folder of TensorBoard's files; None: beside the policy, where the tracker has some
    )
    session: dict[str, Any] = field(default_factory=dict)
    judge: dict[str, Any] | None = None  # session fields by which policies are compared; None: those they learn in
    hyperparameters: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if type(self.threads) is not int or not 1 <= self.threads <= MOST_THREADS:
            raise ValueError(f"threads: expected a whole number from 1 to {MOST_THREADS}, got {self.threads!r}")

    @property
    def learning(self) -> dict[str, Any]:
        """Session fields of the lanes that a policy learns in."""
        start_box = START_BOX if self.start_box is None else self.start_box
        return {"seed": self.seed, "start_box": start_box, **self.session}

    @property
    def judging(self) -> dict[str, Any]:
        return self.session if self.judge is None else self.judge


def chosen_for(view: SurrogateView, settings: TrainSettings, *, by_mean: bool = False) -> TrainSettings:
    """The settings for a policy that is to be used, by what its surrogate's design came to.

    Where repeated steps have shown that the original environment is noisy, the learned noise moves the lanes. Where the
    design is not ready the policy learns on draws, a state a lane (TS1 of Chua et al. 2018): what relies on the mean
    where the model is unsure fails in the original environment. Policies are compared by functions of the posterior:
    draws shake a lane out of a state in which the policy would leave it for good. Who names a variant keeps it, and
    preset ``paper`` has AUR-D. Where a specification pays for leaving what a log has shown, no episode starts
    anywhere else.

    Args:
        view: the surrogate.
        settings: what was asked for.
        by_mean: the search follows the mean without noise, whatever the session.
    """
    if view.spec.design.preset == "paper":
        return settings
    if view.spec.outside_reward is not None and settings.start_box is None:
        settings = replace(settings, start_box=0.0)
    noisy = view.fidelity is not None and any(output.noise > 0 for output in view.fidelity.outputs)
    if noisy and not by_mean:
        settings = replace(settings, session={"process_noise": True, **settings.session})
    if "variant" in settings.session or view.phase == "ready":
        return settings
    other = {name: value for name, value in settings.session.items() if name not in OF_PARTICLES}
    return replace(settings, session=DRAWS | settings.session, judge=FUNCTIONS | other)


def prolongs(settings: TrainSettings, spec: EnvironmentSpec) -> bool:
    """Whether a training that still gains at its end takes as many steps again: where nobody said so, if no number of
    steps was asked for either. Preset ``paper`` has its cap."""
    if settings.prolong is not None:
        return settings.prolong
    return settings.total_steps is None and spec.design.preset != "paper"


def with_folder(settings: TrainSettings, out: Path) -> TrainSettings:
    """The settings with the folder of TensorBoard's files, where the tracker has some: beside the policy by default."""
    if settings.tensorboard is not None or settings.tracker not in ("tensorboard", "wandb"):
        return settings
    return replace(settings, tensorboard=out.parent / TENSORBOARD)


@dataclass(frozen=True)
class TrainProgress:
    steps: int
    total_steps: int
    imagined_return: float | None  # at the last check: mean over virtual episodes from the declared starts
    penalty_share: float  # of the reward's size, since the last report
    episode_penalty: float | None = None  # what it takes off a training episode's return; mean of the last 100
    visited_confidence: float | None = None  # the confidence index where the policy went in the last round


@dataclass(frozen=True)
class TrainResult:
    path: Path
    algorithm: str
    virtual_steps: int
    seconds: float
    imagined_return: float | None  # of the policy that was kept
    lost_episodes: int  # cut because the server lost the session
    settings: dict[str, Any]
    episode_penalty: float | None = None  # what it takes off a training episode's return; mean of the last 100
    networks: int = 1  # that learned in the last training, one after another where one was given up
    gaining: bool = False  # the best policy was still getting better when the training ended
    untrained: float | None = None  # imagined return of a network that has learned nothing; None: not measured
    visited_confidence: tuple[float | None, ...] = ()  # the confidence index where the policy went, of each round


class TrainingInterrupted(KeyboardInterrupt):
    """Ctrl-C came in a training; ``result`` is of the policy that was saved then."""

    def __init__(self, result: TrainResult) -> None:
        super().__init__()
        self.result = result
