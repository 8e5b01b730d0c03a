"""Proximal policy optimisation without torch, as a policy search."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from threadpoolctl import threadpool_limits

from surrogym_client.environments.lanes import Lanes, session_request
from surrogym_sampler.original.protocol import LONGEST_EPISODE
from surrogym_shared.network import Network
from surrogym_shared.spec import EnvironmentSpec
from surrogym_trainer.evaluation.imagined import DECLARED, observation_statistics
from surrogym_trainer.policies.defaults import (
    ATTEMPT_SEED,
    HIDDEN,
    LANES,
    LAST_RATE,
    LEARNING_RATE,
    WIDER,
    decaying,
)
from surrogym_trainer.policies.files import load_policy
from surrogym_trainer.policies.predict import Predict
from surrogym_trainer.training.fast_ppo.learner import (
    Batch,
    LearnedNetwork,
    Learner,
    Objective,
    compiled_update,
    noisy,
    restored,
)
from surrogym_trainer.training.fast_ppo.long_episodes import with_short_episodes
from surrogym_trainer.training.fast_ppo.rollouts import Collector, Rollout
from surrogym_trainer.training.proportions import even_batch, explores_further, suggested_gamma
from surrogym_trainer.training.search import REFERENCE, SEARCHES, Found, PolicySearch, SearchTask
from surrogym_trainer.training.settings import TrainProgress, TrainSettings
from surrogym_trainer.training.verdicts import Imagined, Verdicts, checked

if TYPE_CHECKING:
    from surrogym_trainer.training.stable_baselines.search import StableBaselinesSearch

RANGES = {  # whole numbers have whole bounds
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


HELD = 16  # steps that share the noise of the second network

SECOND_SEED = 3_000_017  # difference between the noise seeds of the two trainings with short episodes
FINE_SEED = 2_000_003  # difference between the noise seeds of the fine-tuning and of the training before
FINE = 0.1  # learning rate of the fine-tuning, as a share of the one before
LOOKS = 1 / 8  # largest share of the fine-tuning that only collects observations
CRITIC_ROLLOUTS = 8  # next rollouts, from which the critic alone learns
QUIET = 0.1  # noise at the end of the fine-tuning, as a share of that at its beginning
FRUITLESS = 1 / 2  # share of the fine-tuning after which it ends if the imagined return did not rise


@dataclass(frozen=True)
class FastPpo(PolicySearch):
    """Policy search by PPO in NumPy, with updates that take a sixth of the time of Stable-Baselines3's.

    Networks, loss, Adam, scaled rewards and advantages are those of the search ``PPO``. A network that has learned
    nothing after a quarter of the steps is abandoned, and another one takes the remaining steps. For continuous actions
    its noise is held for ``HELD`` steps. If it is abandoned as well, one of Stable-Baselines3's ``PPO`` follows, with
    state-dependent noise. If episodes are long and nothing ends them, training episodes are short and begin anywhere
    (``with_short_episodes``). If nobody chose steps or discount, a second network then has the discount of whole
    episodes.

    If nobody chose the number of steps, and training episodes are not short, as many steps follow for fine-tuning. All
    of their episodes begin at declared starts. Inputs are standardised by the observations that the policy meets, and
    the critic is a new one. The reason: returns from anywhere can be a thousand times those from the declared starts,
    and critic and advantages then do not resolve the latter.
    """

    n_steps: int = 64  # steps of each lane in a rollout
    n_epochs: int = 10
    batch_size: int | None = None  # None: about 1,024
    learning_rate: float | None = None  # None: decreases from 3e-3 to a fiftieth of it
    gamma: float | None = None  # None: derived from the time limit, or from that of short training episodes
    gae_lambda: float = 0.97
    clip_range: float = 0.2
    vf_coef: float = 0.5
    max_grad_norm: float = 0.5

    suggested_steps = 450_000
    prolongable = True

    def __post_init__(self) -> None:
        for name, (low, high) in RANGES.items():
            value = getattr(self, name)
            if value is not None and not (type(value) in (int, type(low)) and low <= value <= high):
                raise ValueError(f"{name}: expected {low} to {high}, got {value!r}")

    def search(self, task: SearchTask) -> Found:
        if _starts_from_reference(task.settings) and not task.settings.anew:
            return _reference().search(task)  # only Stable-Baselines3 can train its own policies further
        compiled_update()  # loads a linear algebra library now, so that its threads are limited as well
        with threadpool_limits(limits=task.settings.threads):
            cut = with_short_episodes(task, self.n_steps)
            fine = _from_declared_starts(task) if task.prolong and cut is task else None
            twice = task.prolong and cut is not task and self.gamma is None
            with _lanes(cut) as lanes:
                return _Training(self, cut, lanes, fine, twice=twice).run()

    def explorer(self, policy: Path, algorithm: str, num_envs: int) -> Predict:
        if not Network.is_at(policy):
            return _reference().explorer(policy, algorithm, num_envs)
        return noisy(policy)


class _Training:
    """Networks of one training, and the checks that compare them."""

    def __init__(
        self, search: FastPpo, task: SearchTask, lanes: Lanes, fine: SearchTask | None, *, twice: bool
    ) -> None:
        self._search, self._task, self._fine, self._spec = search, task, fine, task.port.spec()
        self._twice = twice  # whether a second network follows, with another discount
        settings = task.settings
        suggested = suggested_gamma(self._spec) if task.gamma is None else task.gamma
        self._gamma = suggested if search.gamma is None else search.gamma
        self._rng = np.random.default_rng(settings.seed)
        mean, deviation = observation_statistics(task.port, settings.seed)
        self._standardisation = np.array(mean), np.array(deviation)
        self._new = self._made()
        self._theirs = _starts_from_reference(settings)
        own = None if self._theirs else settings.start_from
        self._saved = None if own is None else restored(own, self._spec, units_of(self._spec))
        self._rollout = lanes.num_envs * search.n_steps
        self._batch = search.batch_size or even_batch(self._rollout)
        self._objective = Objective(search.clip_range, search.vf_coef, search.max_grad_norm)
        self._lanes, self._lost = lanes, 0
        planned = max(task.steps // self._rollout, 1) * self._rollout
        self._most = planned * (1 + task.prolong + (fine is not None) + twice)  # virtual steps, if all follow
        saved = self._earlier() if settings.anew else None
        self._verdicts = Verdicts(planned, self._imagined(self._new), saved, patient=task.patient)
        self._kept: LearnedNetwork | None = None
        self._collector = Collector(lanes, self._gamma, search.gae_lambda, settings.seed)

    def run(self) -> Found:
        """Train networks one after another until one completes its steps, or Ctrl-C is pressed."""
        verdicts, learner, whole = self._verdicts, self._new, True
        try:
            for learner, hold in self._networks():
                self._learn(learner, verdicts.left, hold)
                if verdicts.given_up:
                    continue
                if self._task.prolong and verdicts.prolong():
                    self._learn(learner, verdicts.left, hold)
                if self._fine is not None and not verdicts.saturated:
                    self._fine_tune(learner, self._fine)
                if self._twice and not verdicts.saturated:
                    learner = self._made()
                    self._learn_again(learner)
                break
            else:
                return self._by_reference()  # a network is only abandoned if steps are left
        except KeyboardInterrupt:
            whole = False
        return self._found(self._kept or _saved(learner), whole=whole)

    def _networks(self) -> Iterator[tuple[Learner, int]]:
        """Iterate over networks to train, each with the number of steps that share its noise: new ones, and in its turn
        the saved one if it had learned anything."""
        anew = self._task.settings.anew
        if anew or self._saved is None:
            yield self._new, 1
        if self._saved is not None:
            best, learned = self._verdicts.knows(self._imagined(self._saved))
            if best:
                self._kept = _saved(self._saved)
            if learned:
                yield self._saved, 1
            elif not anew:
                yield self._new, 1
        if self._theirs:
            return
        if explores_further(self._spec):
            yield self._made(), HELD
            return
        while True:
            yield self._made(), 1

    def _made(self) -> Learner:
        """Return a new network, with other initial parameters each time."""
        return Learner(self._spec, *self._standardisation, units_of(self._spec), self._rng)

    def _earlier(self) -> Imagined | None:
        """Measure the returns of the policy to start from; None if there is none."""
        if self._saved is not None:
            return self._imagined(self._saved)
        settings = self._task.settings
        if settings.start_from is None:
            return None
        predict = load_policy(settings.start_from, REFERENCE, trust=settings.trust_policy)
        return checked(self._task.port, predict, settings)

    def _learn(self, learner: Learner, steps: int, hold: int) -> None:
        """Train one network for ``steps`` virtual steps, or until it is abandoned."""
        verdicts, search = self._verdicts, self._search
        verdicts.begin()
        before = verdicts.own_steps
        for number in range(1, max(steps // self._rollout, 1) + 1):
            rollout = self._collect(learner, before + number * self._rollout, hold)
            if verdicts.given_up or verdicts.saturated:
                return
            remaining = 1 - verdicts.own_steps / (before + steps)
            rate = decaying(remaining) if search.learning_rate is None else search.learning_rate
            self._update(learner, rollout.rows, rate)
        self._check(learner)

    def _fine_tune(self, learner: Learner, task: SearchTask) -> None:
        """Train the best policy further from the declared starts of ``task``. ``FastPpo`` says why."""
        verdicts, search = self._verdicts, self._search
        assert self._kept is not None
        learner.take_up(self._kept)
        before, rate = verdicts.own_steps, LEARNING_RATE if search.learning_rate is None else search.learning_rate
        noise = learner.further.copy()
        verdicts.extend()
        rollouts = max(verdicts.left // self._rollout, 1)
        episode = -(-(self._spec.time_limit or LONGEST_EPISODE) // search.n_steps)
        looks, seen = max(min(episode, int(LOOKS * rollouts)), 1), []
        best, rose = verdicts.best, looks + CRITIC_ROLLOUTS  # the last rollout after which the best return rose
        with _lanes(task) as lanes:
            self._collector = Collector(lanes, self._gamma, search.gae_lambda, task.settings.seed + FINE_SEED)
            for number in range(1, rollouts + 1):
                rows = self._collect(learner, before + number * self._rollout).rows
                if verdicts.best != best:
                    best, rose = verdicts.best, max(number, rose)
                if verdicts.saturated or number - rose > FRUITLESS * rollouts:
                    return
                if number <= looks:
                    seen.append(rows.observations)
                    if number == looks:
                        learner.standardise_anew(np.concatenate(seen), self._rng)
                elif number <= looks + CRITIC_ROLLOUTS:
                    self._update(learner, replace(rows, advantages=np.zeros_like(rows.advantages)), rate)
                else:
                    self._update(learner, rows, FINE * rate * max(1 - number / rollouts, LAST_RATE))
                    learner.limit_noise(noise, 1 - (1 - QUIET) * number / rollouts)
        self._check(learner)

    def _learn_again(self, learner: Learner) -> None:
        """Train a new network with the discount of whole episodes, after one with that of short episodes.

        Only the imagined returns tell which of the two serves a task. ``with_short_episodes`` says why.
        """
        verdicts, search = self._verdicts, self._search
        kept, gamma = self._kept, self._gamma
        self._gamma = suggested_gamma(self._spec)
        self._collector = Collector(self._lanes, self._gamma, search.gae_lambda, self._task.settings.seed + SECOND_SEED)
        verdicts.extend()
        verdicts.restart()
        try:
            self._learn(learner, verdicts.left, 1)
        finally:
            if self._kept is kept:
                self._gamma = gamma

    def _collect(self, learner: Learner, steps: int, hold: int = 1) -> Rollout:
        """Collect the rollout with which the present network will have taken ``steps``, and check it if that is due."""
        verdicts = self._verdicts
        rollout = self._collector.collect(learner, self._search.n_steps, hold)
        verdicts.saw(rollout.earned)
        verdicts.at(steps)
        self._lost += rollout.lost
        self._after(learner, rollout)
        return rollout

    def _after(self, learner: Learner, rollout: Rollout) -> None:
        verdicts = self._verdicts
        if verdicts.after_rollout():
            self._check(learner)
            verdicts.judge()
        steps = min(verdicts.steps, verdicts.total)
        penalty = self._collector.episode_penalty
        most = max(verdicts.total, self._most)
        self._task.progress(TrainProgress(steps, most, verdicts.latest, rollout.penalty_share, penalty))

    def _update(self, learner: Learner, rows: Batch, rate: float) -> None:
        size = len(rows.returns)
        for _ in range(self._search.n_epochs):
            shuffled = rows.at(self._rng.permutation(size))
            for begin in range(0, size, self._batch):
                learner.update(shuffled.at(slice(begin, begin + self._batch)), self._objective, rate)
        learner.keep_noise(self._task.noise)

    def _check(self, learner: Learner) -> None:
        if self._verdicts.check(self._imagined(learner)):
            self._kept = _saved(learner)

    def _imagined(self, learner: Learner) -> Imagined:
        return checked(self._task.port, learner.policy(), self._task.settings)

    def _found(self, policy: LearnedNetwork, *, whole: bool) -> Found:
        verdicts = self._verdicts
        chosen = {"gamma": self._gamma, "batch_size": self._batch, "net_arch": units_of(self._spec)}
        lanes = {"num_envs": self._lanes.num_envs, "start_box": self._task.settings.learning["start_box"]}
        ran_with = {**asdict(self._search), **chosen, **lanes, "total_steps": verdicts.total}
        if "time_limit" in self._task.settings.session:
            ran_with["time_limit"] = self._task.settings.session["time_limit"]
        return Found(
            policy,
            verdicts.steps,
            verdicts.best,
            ran_with,
            whole=whole,
            episode_penalty=self._collector.episode_penalty,
            lost_episodes=self._lost,
            networks=verdicts.networks,
            gaining=verdicts.gaining,
            untrained=verdicts.floor,
        )

    def _by_reference(self) -> Found:
        """Train ``PPO`` of Stable-Baselines3 for the remaining steps, and return its policy or the best earlier one.

        It begins with its own saved policy if there is one, and else with a new network.
        """
        verdicts, task = self._verdicts, self._task
        spent, left = verdicts.steps, max(verdicts.left, 1)
        start = task.settings.start_from if self._theirs else None
        chosen = {} if self._theirs else _reference().exploring_by_state(self._spec)
        seed = task.settings.seed + ATTEMPT_SEED
        settings = replace(task.settings, seed=seed, start_from=start, hyperparameters=chosen, anew=False)

        def shifted(now: TrainProgress) -> None:
            task.progress(replace(now, steps=spent + now.steps, total_steps=spent + now.total_steps))

        other = _reference(**chosen).search(replace(task, settings=settings, steps=left, progress=shifted))
        theirs, best = other.imagined_return, other
        if self._kept is not None and verdicts.best is not None and (theirs is None or verdicts.best > theirs):
            best = self._found(self._kept, whole=other.whole)
        networks = verdicts.networks + other.networks
        return replace(best, virtual_steps=spent + other.virtual_steps, networks=networks)


def _starts_from_reference(settings: TrainSettings) -> bool:
    """Whether the policy to start from is one of Stable-Baselines3."""
    return settings.start_from is not None and not Network.is_at(settings.start_from)


def units_of(spec: EnvironmentSpec) -> tuple[int, ...]:
    """Return the numbers of units in the actor's hidden layers: two wider layers, or the paper's one."""
    return WIDER if spec.preset.wide_networks else (HIDDEN,)


def _saved(learner: Learner) -> LearnedNetwork:
    return LearnedNetwork(learner.policy(), learner.state())


def _reference(**hyperparameters: Any) -> StableBaselinesSearch:
    """Return the ``PPO`` search of Stable-Baselines3.

    Raises:
        ModuleNotFoundError: it is not installed.
    """
    return cast("StableBaselinesSearch", SEARCHES.get(REFERENCE)(**hyperparameters))


def _from_declared_starts(task: SearchTask) -> SearchTask:
    """Return the task with every episode from a declared start."""
    session = {**task.settings.session, **DECLARED}
    return replace(task, settings=replace(task.settings, horizon=None, session=session))


@contextmanager
def _lanes(task: SearchTask) -> Iterator[Lanes]:
    settings = task.settings
    lanes = Lanes(task.port, session_request(settings.num_envs or LANES, "same_step", settings.learning))
    try:
        yield lanes
    finally:
        lanes.close()
