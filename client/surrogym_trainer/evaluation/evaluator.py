"""The evaluation of a policy by real episodes in the original environment, whose steps are counted, and how these
episodes kept the limits of their specification."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surrogym_client.runtime.lifetime import signals_between_steps
from surrogym_sampler.original.actions import decode_actions, explored
from surrogym_sampler.original.episode import Episode, Moment
from surrogym_sampler.original.episodes import draw
from surrogym_sampler.original.errors import RAISED, EvaluationFailed, PolicyMisfit
from surrogym_sampler.original.fitting import check_policy
from surrogym_sampler.original.periods import is_timed
from surrogym_sampler.original.protocol import LONGEST_EPISODE
from surrogym_shared.limits import KeptEpisodes, limits_of, must_stop, past, room
from surrogym_shared.logs.rewards import declared_reward
from surrogym_shared.set_points import with_set_points
from surrogym_shared.spec import Coordinate, EnvironmentSpec, Success, limits
from surrogym_shared.terms import holds
from surrogym_shared.wire import TraceRank
from surrogym_trainer.policies.predict import Acting, PerEpisode

Array = NDArray[np.float64]
# Called with the share of the work that is done, in [0, 1], and the number of episodes that terminated.
Progress = Callable[[float, int], None]

FIRST_SEED = 10_000
FEW_EQUAL = 3  # once this number of episodes has ended, a remark warns if all are equal in every number
EXPLORING = 1  # second part of the seed of the random changes of actions; the first part is the seed of the episode
# a constant coordinate may change within an episode by this share of its range and still count as constant
ROUNDING = 1e-6


@dataclass(frozen=True)
class EvaluationSettings:
    """Settings of an evaluation: number of episodes, their starts, and changes of the environment.

    Attributes:
        episodes: number of episodes.
        first_seed: reset seed of the first episode; each further one adds 1.
        wide: whether to start anywhere in the sampling range.
        start_scale: factor by which declared starts are moved away from the middle of their range; 1 leaves them as
            they are.
        perturb: standard deviation of the random factors, of mean 1, by which physical attributes such as masses are
            multiplied in each episode; 0 leaves them as they are.
        explore: size of random changes of the actions, from 0 (none) to 1: the standard deviation of noise on a
            continuous action, as a share of half its range; the probability that a discrete action becomes a random
            one.
        parallel: number of instances of the environment that are open at once. None takes one for each episode if the
            environment declares that it runs in parallel, and a single one otherwise.
    """

    episodes: int = 100
    first_seed: int = FIRST_SEED
    wide: bool = False
    start_scale: float = 1.0
    perturb: float = 0.0
    explore: float = 0.0
    parallel: int | None = None

    def __post_init__(self) -> None:
        if self.episodes < 1 or (self.parallel is not None and self.parallel < 1):
            raise ValueError(
                f"expected at least 1 for episodes and for parallel, got {self.episodes} and {self.parallel}"
            )
        if self.wide and self.start_scale != 1:
            raise ValueError("expected either wide or start_scale, got both: leave one out")
        if not 0 <= self.explore <= 1:
            raise ValueError(f"expected explore to be a share from 0 to 1, got {self.explore}")

    @property
    def declared(self) -> bool:
        """Whether the episodes start as declared, in the unchanged environment, with unchanged actions of
        the policy."""
        return not self.wide and self.start_scale == 1 and not self.perturb and not self.explore


@dataclass(frozen=True)
class Trace:
    """The record of one episode, step by step."""

    coordinates: Array  # (T + 1, C) states, from the start to the end of T steps
    action: Array  # (T, F) action of each step
    reward: Array  # (T,) reward of each step
    terminated: bool = False  # whether the last step terminated the episode
    seconds: tuple[float, ...] = ()  # (T - 1,) from the end of one step to that of the next; () if not measured


@dataclass(frozen=True)
class Evaluation:
    """The result of N real episodes."""

    returns: Array  # (N,) return of each episode
    lengths: NDArray[np.int64]  # (N,) number of steps of each episode
    success: NDArray[np.bool_] | None  # (N,) whether each episode succeeded; None if the specification has no criterion
    traces: tuple[Trace, ...]  # record of each of the N episodes, step by step
    varied: tuple[str, ...] = ()  # names of constants of the specification that changed within an episode
    limit: int | None = None  # largest number of steps in an episode, by the specification or by the environment itself
    seeded: bool = True  # whether a second reset with the first seed began in the same state
    # How the limits that the specification declares were kept; None if it declares none.
    limits: KeptEpisodes | None = None

    @property
    def trace(self) -> Trace:
        """The trace of the first episode."""
        return self.traces[0]

    def ranked(self) -> dict[TraceRank, int]:
        """Return the indices of the best, the median and the worst episode by return. In few episodes they may
        coincide."""
        order = np.argsort(self.returns, kind="stable")
        return {"best": int(order[-1]), "median": int(order[(len(order) - 1) // 2]), "worst": int(order[0])}

    @property
    def steps(self) -> int:
        """Number of real steps taken."""
        return int(self.lengths.sum())

    @property
    def equal(self) -> bool:
        """Whether the evaluation has several episodes and all of them are equal in every number, so that one episode
        would have been enough."""
        return len(self.traces) > 1 and all(_is_equal(self.trace, other) for other in self.traces[1:])

    @property
    def success_rate(self) -> float | None:
        return None if self.success is None else float(self.success.mean())

    def summary(self) -> dict[str, Any]:
        """Return statistics of the returns, and the return of every episode, as a JSON object."""
        return {
            "mean": float(self.returns.mean()),
            "iqm": interquartile_mean(self.returns),
            "min": float(self.returns.min()),
            "max": float(self.returns.max()),
            "std": float(self.returns.std()),
            "episodes": len(self.returns),
            "mean_length": float(self.lengths.mean()),
            "success_rate": self.success_rate,
            "steps": self.steps,
            "varied": list(self.varied),
            "equal": self.equal,
            "limit": self.limit,
            "seeded": self.seeded,
            **({} if self.limits is None else {"limits": self.limits.summary()}),
            "per_episode": [float(r) for r in self.returns],
        }


def _is_equal(one: Trace, other: Trace) -> bool:
    """Return whether two episodes are equal in every number."""
    return one.terminated == other.terminated and all(
        np.array_equal(getattr(one, name), getattr(other, name)) for name in ("coordinates", "action", "reward")
    )


def for_set_points(result: Evaluation, spec: EnvironmentSpec | None, points: Mapping[str, float]) -> Evaluation:
    """Return an evaluation whose returns are those of the declared reward with other set points, computed from the
    states and actions of each step. The traces keep the rewards of the environment. No success is judged.

    Args:
        result: the episodes.
        spec: specification with the declared reward.
        points: set points, by coordinate; empty: the evaluation is returned as it is.
    """
    if not points or spec is None:
        return result
    aimed, returns = with_set_points(spec, points), []
    for trace in result.traces:
        ended = np.zeros(len(trace.reward), dtype=bool)
        ended[-1:] = trace.terminated
        before, after = trace.coordinates[:-1], trace.coordinates[1:]
        returns.append(float(declared_reward(aimed, before, trace.action, after, ended).sum()))
    return replace(result, returns=np.array(returns), success=None)


class EvaluationInterrupted(KeyboardInterrupt):
    """Ctrl-C interrupted an evaluation; ``steps`` is the number of real steps begun by then, and ``limits`` counts how
    the episodes so far kept declared limits."""

    def __init__(self, steps: int, limits: KeptEpisodes | None = None) -> None:
        super().__init__()
        self.steps, self.limits = steps, limits


def evaluate(
    policy: Acting,
    open_episode: Callable[[], Episode],
    settings: EvaluationSettings | None = None,
    progress: Progress | None = None,
    remark: Callable[[str], None] | None = None,
    trained_for: EnvironmentSpec | None = None,
    begin: Callable[[EnvironmentSpec], None] | None = None,
) -> Evaluation:
    """Run N real episodes with a policy.

    Each episode runs in one instance of the environment. By default there is one instance, and the episodes run one
    after the other. With several, the policy is called once for all running episodes. Ctrl-C takes effect between two
    steps, a second Ctrl-C at once. Every instance is closed in any case.

    Args:
        policy: function from observations (N, D) to actions, or a controller that also gets the numbers of the
            episodes.
        open_episode: opens one instance of the environment.
        settings: number of episodes, their starts and the environment's perturbation.
        progress: called after every step.
        remark: called with a sentence if the first episodes are equal and others are still to begin, and if no other
            episode of a machine begins because too many left a limit.
        trained_for: specification that the policy was trained for, such as that of its card. The environment must fit.
        begin: called with the environment's specification when it is open and fits, before the first reset.

    Returns:
        The returns and successes of the episodes, in the order of their seeds. The number of instances has an effect
        only if the policy answers a batch of observations differently from single ones, usually in the last bits.

    Raises:
        PolicyMisfit: the policy was trained for another environment, which was then not even reset; or it gave actions
            that are not the environment's, and nothing was sent.
        EvaluationFailed: the environment or the policy raised an error after real steps, which are counted.
        EvaluationInterrupted: Ctrl-C was pressed; real steps so far are counted.
    """
    run = _Run(policy, settings or EvaluationSettings(), progress, remark)
    try:
        with signals_between_steps() as heed, ExitStack() as instances:
            opened = _open(open_episode, run.settings, instances, trained_for)
            if begin is not None:
                begin(opened[0].spec)
            return run.on(opened, heed)
    except KeyboardInterrupt:
        raise EvaluationInterrupted(run.begun, run.kept) from None
    except RAISED as error:
        if run.begun == 0 and not isinstance(error, SystemExit):
            raise
        raise EvaluationFailed(run.begun, error, run.kept) from error


def _open(
    open_episode: Callable[[], Episode],
    settings: EvaluationSettings,
    instances: ExitStack,
    trained_for: EnvironmentSpec | None,
) -> list[Episode]:
    """Open as many instances as may be open at once, at most one for each episode. ``instances`` will close them.

    Raises:
        PolicyMisfit: the environment does not fit ``trained_for``; one instance was opened.
    """

    def open_one() -> Episode:
        episode = open_episode()
        instances.callback(episode.close)
        return episode

    first = open_one()
    if trained_for is not None:
        check_policy(trained_for, first.spec)
    allowed = settings.parallel or (settings.episodes if first.parallel else 1)
    return [first, *(open_one() for _ in range(min(allowed, settings.episodes) - 1))]


def interquartile_mean(values: Array) -> float:
    """Return the mean of the middle half of the values (n,)."""
    cut = len(values) // 4
    return float(np.sort(values)[cut : len(values) - cut].mean())


@dataclass
class _Tally:
    """The sums and the record of one running episode, which begins at the current state of ``episode``."""

    number: int  # number of the episode, from 0, in the order of the seeds
    episode: Episode
    moment: Moment
    rng: np.random.Generator  # generator of the random changes of actions
    total: float = 0.0
    length: int = 0
    held: int = 0  # number of last steps in a row that met the success criterion
    fallbacks: int = 0  # number of steps in which the fallback acted in the place of the policy
    limit: int = field(init=False)
    timed: bool = field(init=False)  # whether the times of steps are measured
    path: list[Array] = field(default_factory=list)
    actions: list[Array] = field(default_factory=list)
    rewards: list[float] = field(default_factory=list)
    times: list[float] = field(default_factory=list)  # when each step ended

    def __post_init__(self) -> None:
        self.limit = self.episode.spec.time_limit or LONGEST_EPISODE
        self.timed = is_timed(self.episode, self.episode.spec)
        self.path.append(self.moment.coordinates)

    @property
    def over(self) -> bool:
        return self.moment.terminated or self.moment.truncated or self.length >= self.limit

    @property
    def trace(self) -> Trace:
        """The episode so far, which must have at least one step."""
        ended = self.moment.terminated
        seconds = tuple(np.diff(self.times).tolist())
        return Trace(np.stack(self.path), np.stack(self.actions), np.array(self.rewards), ended, seconds)

    def step(self, action: Array) -> None:
        """Take one real step, and add it to the sums."""
        self.moment = moment = self.episode.step(action)
        if self.timed:
            self.times.append(time.monotonic())
        self.total += moment.reward
        self.length += 1
        self.held = self.held + 1 if _holds(self.episode.spec, moment.coordinates) else 0
        self.path.append(moment.coordinates)
        self.fallbacks += moment.fell_back
        self.actions.append(action if moment.applied is None else moment.applied)
        self.rewards.append(moment.reward)


class _Run:
    """An evaluation that is running: episodes begin in the order of their seeds, each as soon as an
    instance is free."""

    def __init__(
        self,
        policy: Acting,
        settings: EvaluationSettings,
        progress: Progress | None,
        remark: Callable[[str], None] | None,
    ) -> None:
        self.settings = settings
        self.begun = 0  # number of real steps begun, including interrupted and failed ones
        self._wanted = settings.episodes  # number of episodes to take
        self._seeded = True
        self._policy = policy
        self._progress = progress
        self._remark = remark
        self._looked = False  # whether the first episodes were compared with each other
        self._tallies: list[_Tally] = []

    def on(self, instances: Sequence[Episode], between_steps: Callable[[], None]) -> Evaluation:
        """Run all episodes in these open instances of the environment, and return the result. ``between_steps`` is
        called each time all running episodes have taken a step."""
        free, running = list(instances), list[_Tally]()
        while running or len(self._tallies) < self._wanted:
            running += self._begin(free)
            self._step(running)
            free = [tally.episode for tally in running if tally.over]
            if free:
                running = [tally for tally in running if not tally.over]
                self._look_for_equal_ones()
                self._stop_if_limits_are_left()
            self._tell()
            between_steps()
        return replace(_account(self._tallies), seeded=self._seeded)

    @property
    def kept(self) -> KeptEpisodes | None:
        """How the episodes with at least one whole step kept declared limits so far; None without such an episode."""
        moved = [tally for tally in self._tallies if tally.length]
        if not moved or (spec := moved[0].episode.spec).limits is None:
            return None
        return limits_kept(spec, [np.stack(tally.path) for tally in moved], [tally.fallbacks for tally in moved])

    def _begin(self, free: Sequence[Episode]) -> list[_Tally]:
        """Begin the next episodes, one in each free instance, until all have begun."""
        first = len(self._tallies)
        before = _reset(free[0], self.settings) if first == 0 else None
        begun = [
            _Tally(first + i, episode, _start(episode, self.settings, first + i), self._noise(first + i))
            for i, episode in enumerate(free[: self._wanted - first])
        ]
        if before is not None:
            self._seeded = _same_start(free[0].spec, before, begun[0].moment.coordinates)
        self._tallies += begun
        return begun

    def _noise(self, number: int) -> np.random.Generator:
        return np.random.default_rng([self.settings.first_seed + number, EXPLORING])

    def _step(self, running: Sequence[_Tally]) -> None:
        share = self.settings.explore
        for tally, action in zip(running, self._actions(running), strict=True):
            self.begun += 1
            tally.step(explored(tally.episode.spec, action, share, tally.rng) if share else action)

    def _actions(self, running: Sequence[_Tally]) -> Array:
        """Return the policy's actions (N, F) for the N running episodes."""
        observations = np.stack([tally.moment.observation for tally in running]).astype(np.float32)
        try:
            return decode_actions(running[0].episode.spec, self._act(running, observations), len(running))
        except ValueError as error:
            raise PolicyMisfit(f"the policy does not fit the environment: {error}") from error

    def _act(self, running: Sequence[_Tally], observations: NDArray[np.float32]) -> NDArray[Any]:
        if isinstance(self._policy, PerEpisode):
            return self._policy.actions([tally.number for tally in running], observations)
        return self._policy(observations)

    def _look_for_equal_ones(self) -> None:
        """Send a remark if all episodes that have ended are equal, while stopping can still save real steps."""
        over = [tally for tally in self._tallies if tally.over]
        if self._remark is None or len(over) < FEW_EQUAL or len(self._tallies) == self.settings.episodes:
            return
        first, remark = over[0].trace, self._remark
        if self._looked:
            return
        self._looked = True
        if all(_is_equal(first, tally.trace) for tally in over[1:]):
            remark(
                f"the first {len(over)} of {self.settings.episodes} episodes are equal in every number: if nothing is "
                "random, all will be; --episodes takes fewer"
            )

    def _stop_if_limits_are_left(self) -> None:
        """Begin no other episode if too many left a limit of the specification. A simulator, which nothing damages,
        takes all of them."""
        over = [tally for tally in self._tallies if tally.over]
        spec, simulated = over[0].episode.spec, over[0].episode.parallel
        if spec.limits is None or simulated or len(self._tallies) == self._wanted:
            return
        left = sum(bool(past(spec, np.stack(tally.path)).any()) for tally in over)
        if must_stop(left, len(over), spec.limits.probability):
            self._wanted = len(self._tallies)
            if self._remark is not None:
                self._remark(
                    f"{left} of {len(over)} episodes left a limit, which is more than the allowed "
                    f"{100 * spec.limits.probability:g} % explain, so no other episode begins: choose a larger margin, "
                    "a smaller range of actions, or a fallback that holds, and train anew"
                )

    def _tell(self) -> None:
        if self._progress is not None:
            shares = (1.0 if tally.over else tally.length / tally.limit for tally in self._tallies)
            terminated = sum(tally.moment.terminated for tally in self._tallies)
            self._progress(sum(shares) / self.settings.episodes, terminated)


def _start(episode: Episode, settings: EvaluationSettings, index: int) -> Moment:
    seed = settings.first_seed + index
    rng = np.random.default_rng(seed)
    if settings.perturb > 0:
        episode.perturb(rng, settings.perturb)
    if settings.wide or settings.start_scale != 1:
        return episode.place(draw(episode.spec, rng, wide=settings.wide, scale=settings.start_scale))
    return episode.reset(seed)


def _reset(episode: Episode, settings: EvaluationSettings) -> Array | None:
    """Reset the environment with the seed of the first episode, and return the start (C,). If the first episode then
    starts elsewhere, the environment ignores seeds. None if the settings choose the starts in place of a reset."""
    if settings.wide or settings.start_scale != 1:
        return None
    return episode.reset(settings.first_seed).coordinates


def _same_start(spec: EnvironmentSpec, one: Array, other: Array) -> bool:
    """Return whether two starts are equal, apart from rounding."""
    return all(abs(b - a) <= ROUNDING * span(c) for c, a, b in zip(spec.coordinates, one, other, strict=True))


def _limit(tallies: Sequence[_Tally]) -> int | None:
    """Return the time limit of the episodes: the specification's, or a shorter one that the environment itself has."""
    declared = tallies[0].episode.spec.time_limit
    own = [t.length for t in tallies if t.moment.truncated and t.length < t.limit]
    return min(own) if own else declared


def _account(tallies: Sequence[_Tally]) -> Evaluation:
    spec = tallies[0].episode.spec
    criterion, paths = spec.success, [np.stack(tally.path) for tally in tallies]
    fallbacks = [tally.fallbacks for tally in tallies]
    return Evaluation(
        returns=np.array([t.total for t in tallies]),
        lengths=np.array([t.length for t in tallies], dtype=np.int64),
        success=None
        if criterion is None
        else np.array([_meets(criterion, t.held, t.length, t.total, terminated=t.moment.terminated) for t in tallies]),
        traces=tuple(tally.trace for tally in tallies),
        varied=_varied(spec, tallies),
        limit=_limit(tallies),
        limits=None if spec.limits is None else limits_kept(spec, paths, fallbacks),
    )


def span(coordinate: Coordinate) -> float:
    """Return the width of a coordinate's sampling range."""
    low, high = limits(coordinate.sampling)
    return high - low


def _varied(spec: EnvironmentSpec, tallies: Sequence[_Tally]) -> tuple[str, ...]:
    """Return the names of constants that changed within an episode, such as setpoints of a schedule."""
    names = []
    for i, coordinate in enumerate(spec.coordinates):
        moved = max(float(np.ptp(np.stack(t.path)[:, i])) for t in tallies)
        if coordinate.kind == "constant" and moved > ROUNDING * span(coordinate):
            names.append(coordinate.name)
    return tuple(names)


def _holds(spec: EnvironmentSpec, coordinates: Array) -> bool:
    if spec.success is None:
        return False
    return all(bool(holds(spec, inequality, coordinates[None])[0]) for inequality in spec.success.hold)


def _meets(success: Success, held: int, length: int, total: float, *, terminated: bool) -> bool:
    """Return whether an episode meets every criterion of ``success``. ``held`` is the number of its last steps in which
    all inequalities hold."""
    return (
        (not success.hold or held >= success.hold_steps)
        and (success.min_steps is None or length >= success.min_steps)
        and (success.terminated is None or terminated == success.terminated)
        and (success.min_return is None or total >= success.min_return)
    )


def succeeded(spec: EnvironmentSpec, next_coordinates: Array, rewards: Array, *, terminated: bool) -> bool:
    """Return whether an episode of T steps succeeded, from the states (T, C) and the rewards (T,) after its steps. It
    did if the specification declares no success."""
    if spec.success is None:
        return True
    held = 0
    for state in next_coordinates[::-1]:
        if not _holds(spec, state):
            break
        held += 1
    return _meets(spec.success, held, len(rewards), float(rewards.sum()), terminated=terminated)


def limits_kept(spec: EnvironmentSpec, paths: Sequence[NDArray[np.float64]], fallbacks: Sequence[int]) -> KeptEpisodes:
    """Count the episodes that left a limit.

    Args:
        spec: specification with limits.
        paths: states (T + 1, C) of each episode, at least one.
        fallbacks: number of steps of each episode in which the fallback acted.
    """
    least = np.min([room(spec, path).min(axis=0) for path in paths], axis=0)
    return KeptEpisodes(
        episodes=len(paths),
        violations=sum(bool(past(spec, path).any()) for path in paths),
        fallbacks=sum(fallbacks),
        fallback_episodes=sum(count > 0 for count in fallbacks),
        steps=sum(len(path) - 1 for path in paths),
        least_room=dict(zip((limit.name for limit in limits_of(spec).keep), least.tolist(), strict=True)),
        probability=limits_of(spec).probability,
    )
