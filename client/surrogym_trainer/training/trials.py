"""Learn by trying, where the original environment can only be reset: a policy is trained, a sampler runs it for an
episode of the original environment (a trial), the model learns from these steps, and another policy is trained.

A sequence of actions that was planned beforehand leaves the states that matter as soon as the model is a little wrong.
A policy reacts to what was measured, and takes the machine where good policies go.
"""

from __future__ import annotations

import math
from base64 import b64encode
from contextlib import suppress
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from surrogym_client.environments.lanes import Lanes, session_request
from surrogym_client.errors import SurrogymClientError
from surrogym_client.surrogates.waiting import COMPLETED, wait_for_design
from surrogym_client.transport.api import Api
from surrogym_sampler.original.protocol import LONGEST_EPISODE
from surrogym_shared.network import Network
from surrogym_shared.port import SurrogatePort
from surrogym_shared.set_points import with_set_points
from surrogym_shared.spec import EnvironmentSpec
from surrogym_shared.wire import QueryView, Trial
from surrogym_trainer.evaluation.evaluator import succeeded
from surrogym_trainer.evaluation.imagined import imagined_returns
from surrogym_trainer.policies.files import load_network
from surrogym_trainer.policies.integrals import IntegralPort
from surrogym_trainer.training.closed_loop import CLEARLY, EPISODES, TrainingInRounds, shifted
from surrogym_trainer.training.search import planned_steps, search_for, with_algorithm
from surrogym_trainer.training.settings import TrainResult, TrainSettings, chosen_for

# With lags, default share of virtual episodes that start at states of real steps, whose lags are possible ones.
VISITED = 0.5
SHORTEST = 0.25  # smallest share of an episode that is worth a trial
MOST_ROUNDS = 20  # largest number of trials, if no number is requested
# If no trial was confirmed before the budget was spent, the last training takes this multiple of the usual steps.
LONGER = 4
NOTICEABLE = 0.02  # share of a policy's gain over an untrained one; a smaller change does not matter


def allows_trials(spec: EnvironmentSpec, settings: TrainSettings) -> bool:
    """Whether policies of a search try an environment: only they can steer it, and they are networks of
    arrays."""
    return spec.needs_trials and search_for(with_algorithm(settings, spec)).saves_network


def encoded(policy: Network, port: SurrogatePort) -> str:
    """Return the content of a policy's file in base64, for a sampler, which computes the integrals that the policy sees
    in ``port``."""
    errors = port.errors if isinstance(port, IntegralPort) else ()
    return b64encode(replace(policy, integrals=errors).to_bytes()).decode()


def is_waiting_for_trials(api: Api, name: str) -> bool:
    """Whether the design has ended, or only takes or learns a trial of another training; and it is not ready, its
    budget has steps left, and a sampler is running."""
    view = api.surrogate(name)
    if view.phase in ("ready", "failed") or view.budget_left <= 0 or not view.samplers:
        return False
    return view.phase in COMPLETED or any(_is_trial(query) for query in api.queries(name))


def _is_trial(query: QueryView) -> bool:
    return query.policy and query.purpose == "adaptive"  # an audit lets a policy act, too


@dataclass
class Trials(TrainingInRounds):
    """Train policies, each with a new network, and let the best one try an episode after each training.

    The trials end when one has succeeded, the model that has learned from it expects no less of its policy than before,
    and no other policy is clearly better in that model; or after the number of rounds; or when the budget is spent; or
    when the original environment failed at each attempt to take a trial's first step, or the trial was refused or
    withdrawn. A trial succeeds by the criterion of the specification, if there is one. Without a number of steps in
    ``rounds``, a trial is a whole episode, and the trials take the rest of the budget.

    If the budget is spent before, only the search can still improve the policy. So the last training is longer, unless
    the user chose the number of virtual steps.
    """

    _tried: int = field(default=0, init=False)  # number of trials

    def _run(self) -> None:
        tried: tuple[Network, NDArray[np.float64]] | None = None
        for number in range(self._most + 1):
            steps = self._steps_of_a_trial() if number < self._most else 0
            self.best = best = self._learn(number, longer=number > 0 and not steps)
            if not steps:
                break
            policy = load_network(best.path)
            earned = self._earned(policy)
            if tried is not None and self._confirms(*tried, earned, best.untrained or 0.0):
                break
            if (success := self._try(policy, steps, number)) is None:
                break
            tried = (policy, earned) if success else None

    def result(self) -> TrainResult:
        return replace(super().result(), visited_confidence=(None,) * self._tried)

    @property
    def _most(self) -> int:
        return self.rounds.rounds if self.rounds.queries else MOST_ROUNDS

    def _learn(self, number: int, *, longer: bool) -> TrainResult:
        """Train a policy with a new network, and return the best one so far in the present model."""
        settings, done = self._chosen, self._steps
        lagging = any(coordinate.lag is not None for coordinate in self.port.spec().coordinates)
        usual = lagging and settings.start_box is None and settings.start_visited is None
        visited = VISITED if usual else settings.start_visited
        now = replace(settings, seed=settings.seed + number, start_visited=visited)
        if longer and settings.total_steps is None:
            now = replace(now, total_steps=LONGER * planned_steps(settings))
        total = done + planned_steps(now) + planned_steps(settings) * self._trials_left(number)
        latest = self._train(now, shifted(self.progress, done, total, None))
        return self.candidates.best(self.port, latest, self._chosen)

    def _confirms(
        self, policy: Network, before: NDArray[np.float64], best: NDArray[np.float64], untrained: float
    ) -> bool:
        """Whether the model, which has learned from the trial of a policy, expects no less of it than ``before`` (e,),
        its returns in e virtual episodes, and nothing clearly better of the best policy, whose returns are ``best``
        (e,). ``untrained`` is the return of an untrained policy."""
        now = self._earned(policy)
        small = NOTICEABLE * abs(float(now.mean()) - untrained)
        return _more(before, now) <= small and _more(best, now) <= small

    def _earned(self, policy: Network) -> NDArray[np.float64]:
        return imagined_returns(self.port, policy, EPISODES, self.settings.seed, **self._chosen.judging)

    def _try(self, policy: Network, steps: int, number: int) -> bool | None:
        """Let a policy try an episode of at most ``steps`` steps, and return whether the episode succeeded. One that an
        error or a stopped sampler cut off has not. Return None if no step could be taken."""
        view, earlier = self.api.surrogate(self.name), {query.id for query in self.api.queries(self.name)}
        actions = expected_actions(self.port, policy, steps, self.settings.seed + number)
        self.api.improve(self.name, trial=Trial(policy=encoded(policy, self.port), actions=actions))
        self._tried += 1
        asked = self._asked(actions, earlier)
        try:
            wait_for_design(self.api, self.name, self.rounds.patience_seconds, self.waiting, after_round=view.round)
        except BaseException:
            with suppress(SurrogymClientError):  # the first error matters
                self.api.withdraw_audit(self.name, asked)
            raise
        taken = [sample for sample in self.api.samples(self.name) if sample.query_id in asked and not sample.late]
        if not taken:
            return None
        whole = len(taken) >= steps or taken[-1].terminated or taken[-1].truncated
        states, rewards = np.array([s.next_coordinates for s in taken]), np.array([s.reward for s in taken])
        spec = with_set_points(self.port.spec(), self.settings.set_points)
        return whole and succeeded(spec, states, rewards, terminated=taken[-1].terminated)

    def _asked(self, actions: list[list[float]], earlier: set[int]) -> list[int]:
        """Return the id of the trial that expects ``actions`` (T, F) and is not among ``earlier`` queries; none if it
        was withdrawn. Other trainings may have added trials since."""
        added = [query for query in self.api.queries(self.name) if _is_trial(query) and query.id not in earlier]
        same = [q.id for q in added if len(q.actions) == len(actions) and np.allclose(q.actions, actions)]
        return same[:1]

    def _trials_left(self, number: int) -> int:
        """Return the largest number of trials of whole episodes after ``number`` trials."""
        if self.rounds.queries:
            return self._most - number
        whole, rest = divmod(self.api.surrogate(self.name).budget_left, self._longest)
        return min(whole + (rest >= SHORTEST * self._longest), self._most - number)

    def _steps_of_a_trial(self) -> int:
        view, longest = self.api.surrogate(self.name), self._longest
        if self.rounds.queries:
            return min(longest, self.rounds.queries)
        return min(longest, view.budget_left) if view.budget_left >= SHORTEST * longest else 0

    @property
    def _longest(self) -> int:
        spec = self.port.spec()
        return min(spec.time_limit or LONGEST_EPISODE, spec.max_rollout or LONGEST_EPISODE, LONGEST_EPISODE)

    @property
    def _chosen(self) -> TrainSettings:
        return chosen_for(self.api.surrogate(self.name), with_algorithm(self.settings, self.port.spec()))


def _more(some: NDArray[np.float64], others: NDArray[np.float64]) -> float:
    """Return by how much the mean of returns (e,) clearly exceeds that of others (e,), from the same starts."""
    more = some - others
    return float(more.mean()) - CLEARLY * float(more.std(ddof=1)) / math.sqrt(len(more))


def expected_actions(port: SurrogatePort, policy: Network, steps: int, seed: int) -> list[list[float]]:
    """Return the actions (T, F) of a policy in T virtual steps, from the declared starts."""
    lanes = Lanes(port, session_request(1, "same_step", {"seed": seed, "start_box": 0.0}))
    actions = []
    try:
        observation = lanes.reset().observation
        for _ in range(steps):
            action = policy(observation)
            actions.append(np.reshape(action, -1).astype(float).tolist())
            observation = lanes.step(action).result.observation
    finally:
        lanes.close()
    return actions
