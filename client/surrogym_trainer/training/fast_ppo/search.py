"""Proximal policy optimisation without torch, as a policy search in two stages: learn and refine. A stage has starts
and lengths of its episodes, and a discount factor."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from surrogym_client.environments.lanes import Lanes, session_request
from surrogym_sampler.original.protocol import LONGEST_EPISODE
from surrogym_shared.network import Network
from surrogym_shared.spec import EnvironmentSpec
from surrogym_trainer.evaluation.imagined import DECLARED, observation_statistics
from surrogym_trainer.policies.card import UnusablePolicy
from surrogym_trainer.policies.defaults import HIDDEN, LANES, LEARNING_RATE, WIDER, decaying
from surrogym_trainer.policies.predict import Predict
from surrogym_trainer.training.checks import Checks, Returns, checked
from surrogym_trainer.training.fast_ppo.learner import (
    Batch,
    LearnedNetwork,
    Learner,
    Objective,
    compiled_update,
    noisy,
    restored,
)
from surrogym_trainer.training.fast_ppo.rollouts import Collector
from surrogym_trainer.training.search import Found, PolicySearch, SearchTask
from surrogym_trainer.training.settings import CHECKS, TrainProgress, TrainSettings, even_batch, suggested_gamma

RANGES = {  # Allowed range of each setting; settings with integer bounds must be integers.
    "n_steps": (1, 100_000),
    "n_epochs": (1, 1_000),
    "batch_size": (1, 10_000_000),
    "learning_rate": (0.0, 1.0),
    "gamma": (0.0, 1.0),
    "gae_lambda": (0.0, 1.0),
    "clip_range": (0.0, 10.0),
    "vf_coef": (0.0, 100.0),
    "max_grad_norm": (0.0, 1e6),
}

# The suggested number of virtual steps is divided into this number of training cycles in the stage ``learn``.
CYCLES = 3
LEARNING = 2  # the stage ``learn`` takes at most this multiple of the suggested number of steps
REFINING = 1 / 4  # the stage ``refine`` takes this share of the steps of a cycle of the stage ``learn``
PATIENT_ROLLOUTS = 32  # a network that has learned nothing is replaced after this number of rollouts at the earliest
HELD = 16  # if actions are continuous, the noise of every second new network stays the same for this number of steps
FINE = 0.1  # learning rate in the stage ``refine``, as a share of that in the stage ``learn``
# the stage ``refine`` first collects observations, without learning, in at most this share of the suggested steps
LOOKS = 1 / 8
CRITIC_ROLLOUTS = 8  # then only the critic learns, in this number of rollouts
STEPS = 16  # number of steps of each lane in a rollout
# Episodes of more than ``LONG`` steps that nothing ends have settings of their own (decision 105): the number of steps
# of each lane in a rollout; the share of its first standard deviation that the actions' noise keeps in the stage
# ``learn``; and the length of a cycle of this stage, as a multiple of the suggested number of steps.
LONG, LONG_STEPS, LONG_NOISE, LONG_CYCLE = 320, 64, 0.6, 3
STAGE_SEED = 2_000_003  # the seed of the actions' noise grows by this number from one stage to the next


@dataclass(frozen=True)
class FastPpo(PolicySearch):
    """Policy search by PPO in compiled code, with updates that take a sixth of the time of Stable-Baselines3's.

    Networks, loss, Adam, scaled rewards and advantages are those of the search ``PPO``. A training has two stages, each
    with cycles in which the learning rate falls. The functions ``learn`` and ``refine`` describe the episodes of the
    two stages, and the reasons.

    1. *learn*: short episodes with a small discount horizon. Another cycle follows if the second half of the previous
       one gained. A network that has learned nothing in its first cycle is replaced. The noise of every second network
       stays the same for ``HELD`` steps if actions are continuous, because a first success may need a steady push.
    2. *refine*: whole episodes from the declared starts, in one cycle. Inputs are standardised by the observations that
       the policy meets, and the critic is a new one.

    If nothing ends the environment's long episodes, the stage *learn* has other starts, a larger discount horizon and
    longer cycles, and keeps its noise. If the user chose the number of steps, they form one cycle of the first stage.
    """

    # number of steps of each lane in a rollout; None takes ``STEPS``, or ``LONG_STEPS`` if nothing ends long episodes
    n_steps: int | None = None
    n_epochs: int = 10
    batch_size: int | None = None  # None takes a batch of about 1,024 steps
    learning_rate: float | None = None  # None lets the learning rate fall from 3e-3 to a fiftieth of that
    # None derives the discount factor from the length of the episodes: the time limit, or that of short training
    # episodes
    gamma: float | None = None
    gae_lambda: float = 0.97
    clip_range: float = 0.2
    vf_coef: float = 0.5
    max_grad_norm: float = 0.5

    suggested_steps = 450_000
    prolongable = True
    whole_episodes = False
    saves_network = True

    def __post_init__(self) -> None:
        for name, (low, high) in RANGES.items():
            value = getattr(self, name)
            if value is not None and not (type(value) in (int, type(low)) and low <= value <= high):
                raise ValueError(f"hyperparameter {name}: expected {low} to {high}, got {value!r}")

    def search(self, task: SearchTask) -> Found:
        start = task.settings.start_from
        if start is not None and not Network.is_at(start):
            why = "it has not saved: leave --algorithm out" if Path(start).is_file() else "is no file"
            raise UnusablePolicy(f"fastppo can't continue {start}, which {why}")
        compiled_update()  # loads the linear algebra library now, so that its threads are limited as well
        with threadpool_limits(limits=task.settings.threads):
            return _Training(self, task).run()

    def explorer(self, policy: Path, algorithm: str, num_envs: int) -> Predict:  # noqa: ARG002
        return noisy(policy)


class _Training:
    """One training: its networks, and the checks that compare them."""

    def __init__(self, search: FastPpo, task: SearchTask) -> None:
        self._search, self._task, self._spec = search, task, task.port.spec()
        settings = task.settings
        self._rng = np.random.default_rng(settings.seed)
        mean, deviation = observation_statistics(task.port, settings.seed)
        self._standardisation = np.array(mean), np.array(deviation)
        self._new = self._made()
        start = settings.start_from
        self._saved = None if start is None else restored(start, self._spec, units_of(self._spec))
        self._num_envs = settings.num_envs or LANES
        self._learning = learn(task)  # the first stage
        long = self._learning.long
        self._steps = search.n_steps or (LONG_STEPS if long else STEPS)
        self._rollout = self._num_envs * self._steps  # number of virtual steps in a rollout
        self._batch = search.batch_size or even_batch(self._rollout)
        self._objective = Objective(search.clip_range, search.vf_coef, search.max_grad_norm)
        planned = task.steps * (LONG_CYCLE if long and task.prolong else 1)
        self._planned = max(planned // self._rollout, 1)  # number of planned rollouts
        self._cycle = max(self._planned // CYCLES, 1) if task.prolong and not long else self._planned
        # numbers of rollouts of the stage ``refine``: those that only collect observations, of an episode in each lane,
        # and those of its cycle
        episode = -(-(self._spec.time_limit or LONGEST_EPISODE) // self._steps)
        self._looks = max(min(episode, int(LOOKS * self._planned)), 1)
        self._refining = max(int(REFINING * self._cycle), 1)
        # number of rollouts left before the stage ``refine``
        self._left = self._planned * (LEARNING if task.prolong else 1)
        saved = self._imagined(self._saved) if settings.anew and self._saved is not None else None
        self._checks = Checks(self._imagined(self._new), saved)
        self._kept: LearnedNetwork | None = None
        self._taken = self._expected = self._lost = self._stages = 0
        self._stage = ""
        self._networks, self._gaining = 1, False
        self._penalty: float | None = None
        self._cycles: list[dict[str, Any]] = []

    def run(self) -> Found:
        """Run the stages until they end, Ctrl-C is pressed, or a step fails."""
        stopped = None
        try:
            for learner, hold in self._candidates():
                self._learn(learner, hold)
                if self._checks.learned or self._checks.saturated or self._left < self._patience:
                    break
                self._networks += 1
            if self._task.prolong and not self._checks.saturated:
                self._refine()
        except (KeyboardInterrupt, Exception) as error:
            stopped = error
        return self._found(stopped)

    @property
    def _patience(self) -> int:
        """Number of rollouts after which a network that has learned nothing is replaced."""
        return max(self._planned // CYCLES, PATIENT_ROLLOUTS)

    def _learn(self, learner: Learner, hold: int) -> None:
        """Train a network in cycles, as long as it gains; its noise stays the same for ``hold`` steps."""
        own, stage = 0, self._learning
        self._gaining = True
        with self._open(stage):
            while self._gaining and self._left > 0 and not self._checks.saturated:
                rollouts = min(self._cycle, self._left)
                taken, self._gaining = self._run_cycle(stage, learner, own, rollouts, hold)
                own, self._left = own + taken, self._left - taken

    def _refine(self) -> None:
        """Run the stage ``refine``: train the best policy further."""
        assert self._kept is not None
        learner, stage = self._made(), refine(self._task)
        learner.take_up(self._kept)
        rate = LEARNING_RATE if self._search.learning_rate is None else self._search.learning_rate
        with self._open(stage):
            self._expect(self._looks + CRITIC_ROLLOUTS + self._refining)
            seen = [self._collect(learner).observations for _ in range(self._looks)]
            learner.standardise_anew(np.concatenate(seen), self._rng)
            for _ in range(CRITIC_ROLLOUTS):
                rows = self._collect(learner)
                self._update(learner, replace(rows, advantages=np.zeros_like(rows.advantages)), rate)
            self._run_cycle(stage, learner, 0, self._refining)

    def _run_cycle(self, stage: Stage, learner: Learner, own: int, rollouts: int, hold: int = 1) -> tuple[int, bool]:
        """Train a network while its learning rate falls. Returns the number of rollouts, and whether another cycle may
        gain.

        Args:
            stage: stage of the training.
            learner: the network.
            own: number of rollouts that the network has learned from in this stage so far. The more there are, the
                lower the learning rate with which the cycle begins.
            rollouts: rollouts of this cycle.
            hold: number of steps for which the noise of its actions stays the same.
        """
        fine, before = stage.name == "refine", self._checks.returns_of_best
        further = self._looks + CRITIC_ROLLOUTS + self._refining if self._task.prolong and not fine else 0
        self._expect(rollouts + further)
        for number in range(1, rollouts + 1):
            rows = self._collect(learner, hold)
            if self._checks.saturated or self._hopeless(own + number, rollouts - number):
                break
            remaining, rate = 1 - (own + number) / (own + rollouts), self._search.learning_rate
            rate = decaying(remaining) if rate is None else rate
            self._update(learner, rows, FINE * rate if fine else rate)
            if stage.long:
                learner.keep_noise(LONG_NOISE)
            if number == rollouts // 2 and not fine:
                self._check(learner)
                before = self._checks.returns_of_best
        else:
            self._check(learner)
        entry = {"stage": stage.name, "network": self._networks, "virtual_steps": self._taken * self._rollout}
        self._cycles.append({**entry, "imagined_return": self._checks.best})
        return number, not self._checks.saturated and self._checks.gained(before)

    def _hopeless(self, own: int, left: int) -> bool:
        """Return whether a network has learned nothing in its first rollouts (``own``, their number), and the rollouts
        ``left`` are enough for another network."""
        return own == self._patience <= left and not self._checks.learned

    def _candidates(self) -> Iterator[tuple[Learner, int]]:
        """Yield networks to train, each with the number of steps for which its noise stays the same: new networks, and
        the saved one if it has learned something."""
        anew = self._task.settings.anew
        if anew or self._saved is None:
            yield self._new, 1
        if self._saved is not None:
            self._check(self._saved)
            if self._checks.learned:
                yield self._saved, 1
            elif not anew:
                yield self._new, 1
        continuous = not self._spec.action.policy_counts and self._spec.preset.adapts_training
        for number in itertools.count():
            yield self._made(), HELD if continuous and number % 2 == 0 else 1

    def _made(self) -> Learner:
        """Return a new network, with other initial parameters each time."""
        return Learner(self._spec, *self._standardisation, units_of(self._spec), self._rng)

    @contextmanager
    def _open(self, stage: Stage) -> Iterator[None]:
        """Open the lanes of a stage."""
        fields = session_request(self._num_envs, "same_step", stage.settings.learning)
        seed = self._task.settings.seed + STAGE_SEED * self._stages
        lanes = Lanes(self._task.port, fields)
        try:
            self._collector = Collector(lanes, self._gamma_of(stage), self._search.gae_lambda, seed)
            self._stages += 1
            self._stage = stage.name
            yield
        finally:
            lanes.close()

    def _gamma_of(self, stage: Stage) -> float:
        return stage.gamma if self._search.gamma is None else self._search.gamma

    def _expect(self, rollouts: int) -> None:
        """Set the number of rollouts that the training still takes, from which reports of progress compute the
        total."""
        self._expected = self._taken + rollouts

    def _collect(self, learner: Learner, hold: int = 1) -> Batch:
        """Collect a rollout, check the policy if a check is due, and report the progress."""
        rollout = self._collector.collect(learner, self._steps, hold)
        self._checks.saw(rollout.earned)
        self._lost += rollout.lost
        before, self._taken = self._taken, self._taken + 1
        if self._taken * CHECKS // self._planned > before * CHECKS // self._planned:
            self._check(learner)
        steps, total = self._taken * self._rollout, max(self._taken, self._expected) * self._rollout
        self._penalty = self._collector.episode_penalty
        self._task.progress(
            TrainProgress(steps, total, self._checks.latest, rollout.penalty_share, self._penalty, stage=self._stage)
        )
        return rollout.rows

    def _update(self, learner: Learner, rows: Batch, rate: float) -> None:
        size = len(rows.returns)
        for _ in range(self._search.n_epochs):
            shuffled = rows.at(self._rng.permutation(size))
            for begin in range(0, size, self._batch):
                learner.update(shuffled.at(slice(begin, begin + self._batch)), self._objective, rate)

    def _check(self, learner: Learner) -> None:
        if self._checks.add(self._imagined(learner)):
            self._kept = _saved(learner)

    def _imagined(self, learner: Learner) -> Returns:
        return checked(self._task.port, learner.policy(), self._task.settings)

    def _found(self, stopped: BaseException | None) -> Found:
        stage = self._learning
        chosen: dict[str, Any] = {"n_steps": self._steps, "gamma": self._gamma_of(stage), "batch_size": self._batch}
        chosen |= {"net_arch": units_of(self._spec), "start_box": stage.settings.learning["start_box"]}
        ran_with = {**asdict(self._search), **chosen, "num_envs": self._num_envs, "cycles": self._cycles}
        if "time_limit" in stage.settings.session:
            ran_with["time_limit"] = stage.settings.session["time_limit"]
        return Found(
            self._kept or _saved(self._new),
            self._taken * self._rollout,
            self._checks.best,
            {**ran_with, "total_steps": self._planned * self._rollout},
            whole=stopped is None,
            stopped=stopped,
            episode_penalty=self._penalty,
            lost_episodes=self._lost,
            networks=self._networks,
            gaining=self._gaining,
            untrained=self._checks.untrained,
        )


def units_of(spec: EnvironmentSpec) -> tuple[int, ...]:
    """Return the numbers of units in the actor's hidden layers: two layers of 64, or with the preset ``paper`` one of
    32."""
    return WIDER if spec.preset.wide_networks else (HIDDEN,)


def _saved(learner: Learner) -> LearnedNetwork:
    return LearnedNetwork(learner.policy(), learner.state())


SHORTER = 5  # in the stage ``learn``, an episode is shorter than the time limit by this factor
SHORTEST = 40  # in the stage ``learn``, an episode has at least this number of steps
SIGHT = 1 / 2  # in short episodes, the discount horizon 1 / (1 - gamma) is this share of the length of an episode


@dataclass(frozen=True)
class Stage:
    """One stage of a training by FastPpo: its name, the settings of its episodes and their discount factor."""

    name: str
    settings: TrainSettings  # settings of the stage's episodes
    gamma: float  # discount factor
    # whether nothing ends the environment's episodes of more than ``LONG`` steps, so that noise and cycles are larger
    long: bool = False


def learn(task: SearchTask) -> Stage:
    """Return the stage of short episodes, half of which begin anywhere, with a discount horizon of half an episode.

    A model can start anywhere, which a machine can't. In short episodes each lane sees many states, including those
    near success, and a short horizon finds a first policy in a tenth of the steps. The last reward of a truncated
    episode includes the critic's value of its last state, so short episodes don't change what is optimal. Starts and
    lengths that the user chose are kept, and so are those of the preset ``paper``. The discount factor is then that of
    whole episodes.

    If nothing ends long episodes, the stage is ``long``: all of its episodes begin anywhere, and the discount horizon
    is a short episode. Most of the return then comes from staying where the reward is. A policy learns early to stay
    there, and only much later the way there, which half an episode's sight and noise that has fallen do not find.
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
    if limit > LONG and spec.termination == () and spec.limits is None:
        return Stage("learn", replace(short, start_box=1.0), 1 - 1 / length, long=True)
    return Stage("learn", short, 1 - 1 / (SIGHT * length))


def refine(task: SearchTask) -> Stage:
    """Return the stage of whole episodes from the declared starts.

    Episodes that start anywhere can have returns a thousand times as large as those from the declared starts. Critic
    and advantages are then not precise enough for the declared starts.
    """
    settings = task.settings
    session = {**settings.session, **DECLARED}
    return Stage("refine", replace(settings, horizon=None, session=session), suggested_gamma(task.port.spec()))
