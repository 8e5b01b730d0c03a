"""What a policy is worth in the original environment: real episodes, counted and judged."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surrogym_client.original.episodes import Episode, Moment, draw
from surrogym_client.original.terms import holds
from surrogym_shared.spec import BoxAction, EnvironmentSpec, Success

Array = NDArray[np.float64]
Predict = Callable[[NDArray[np.float32]], NDArray[Any]]  # observations (N, D) -> actions (N,) or (N, F)

Progress = Callable[[float, int], None]  # share done in [0, 1], episodes that terminated

FIRST_SEED = 10_000
LONGEST_EPISODE = 1_000  # where the specification has no time limit


@dataclass(frozen=True)
class EvaluationSettings:
    """``wide`` starts anywhere in the sampling range, ``start_scale`` spreads the declared starts so many times as far
    about their middle; ``perturb`` is the deviation of physical attributes."""

    episodes: int = 100
    first_seed: int = FIRST_SEED
    wide: bool = False
    start_scale: float = 1.0
    perturb: float = 0.0

    def __post_init__(self) -> None:
        if self.wide and self.start_scale != 1:
            raise ValueError("expected starts over the whole range or scaled ones, got both")


@dataclass(frozen=True)
class Trace:
    """The first episode, step by step."""

    coordinates: Array  # (T + 1, C)
    action: Array  # (T, F)
    reward: Array  # (T,)


@dataclass(frozen=True)
class Evaluation:
    """What N episodes gave."""

    returns: Array  # (N,)
    lengths: NDArray[np.int64]  # (N,)
    success: NDArray[np.bool_] | None  # (N,); None where the specification has no criterion
    trace: Trace

    @property
    def steps(self) -> int:
        """Real steps taken."""
        return int(self.lengths.sum())

    @property
    def success_rate(self) -> float | None:
        return None if self.success is None else float(self.success.mean())

    def summary(self) -> dict[str, Any]:
        """As JSON: statistics of the return, and every episode."""
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
            "per_episode": [float(r) for r in self.returns],
        }


class EvaluationInterrupted(KeyboardInterrupt):
    """Ctrl-C came in an evaluation, after ``steps`` real steps."""

    def __init__(self, steps: int) -> None:
        super().__init__()
        self.steps = steps


def evaluate(
    policy: Predict,
    open_episode: Callable[[], Episode],
    settings: EvaluationSettings | None = None,
    progress: Progress | None = None,
) -> Evaluation:
    """Run N real episodes side by side; the policy is asked once for all that are still running.

    Args:
        policy: observations (N, D) to actions.
        open_episode: makes one episode; called N times.
        settings: how many, from which starts.
        progress: called after every step.

    Returns:
        returns and successes by episode, in the order of their seeds.

    Raises:
        ValueError: the policy gives actions of the wrong shape.
        EvaluationInterrupted: Ctrl-C came; its real steps count all the same.
    """
    settings = settings or EvaluationSettings()
    episodes = [open_episode() for _ in range(settings.episodes)]
    try:
        return _run(policy, episodes, settings, progress)
    finally:
        for episode in episodes:
            episode.close()


def interquartile_mean(values: Array) -> float:
    """Mean of the middle half of values (n,)."""
    cut = len(values) // 4
    return float(np.sort(values)[cut : len(values) - cut].mean())


def decode_actions(spec: EnvironmentSpec, raw: NDArray[Any], lanes: int) -> Array:
    """A policy's actions as the environment takes them, (N, F); the bins of a continuous action are undone.

    Raises:
        ValueError: wrong shape.
    """
    rows = np.asarray(raw, dtype=np.float64)
    if rows.size != lanes * spec.action.size:
        raise ValueError(f"expected actions of shape ({lanes}, {spec.action.size}), got {np.shape(raw)}")
    rows = rows.reshape(lanes, spec.action.size)
    if not isinstance(spec.action, BoxAction):
        return rows
    low, high = np.array(spec.action.low), np.array(spec.action.high)
    if spec.action.bins is not None:
        return np.asarray(low + rows * (high - low) / (np.array(spec.action.bins) - 1))
    return np.clip(rows, low, high)


@dataclass
class _Tally:
    """One running episode's account."""

    moment: Moment
    total: float = 0.0
    length: int = 0
    held: int = 0  # steps in a row for which the success criterion has held
    path: list[Array] = field(default_factory=list)
    actions: list[Array] = field(default_factory=list)
    rewards: list[float] = field(default_factory=list)

    def add(self, spec: EnvironmentSpec, action: Array, moment: Moment) -> None:
        self.moment = moment
        self.total += moment.reward
        self.length += 1
        self.held = self.held + 1 if _holds(spec, moment.coordinates) else 0
        self.path.append(moment.coordinates)
        self.actions.append(action)
        self.rewards.append(moment.reward)


def _run(
    policy: Predict,
    episodes: Sequence[Episode],
    settings: EvaluationSettings,
    progress: Progress | None,
) -> Evaluation:
    spec = episodes[0].spec
    tallies = [_Tally(_start(e, settings, i)) for i, e in enumerate(episodes)]
    start = tallies[0].moment.coordinates
    try:
        _finish(policy, episodes, tallies, progress)
    except KeyboardInterrupt:
        raise EvaluationInterrupted(sum(tally.length for tally in tallies)) from None
    return _account(spec, tallies, start)


def _finish(policy: Predict, episodes: Sequence[Episode], tallies: Sequence[_Tally], progress: Progress | None) -> None:
    """Step every episode to its end."""
    spec = episodes[0].spec
    running = list(range(len(episodes)))
    limit = spec.time_limit or LONGEST_EPISODE
    for step in range(1, limit + 1):
        observations = np.stack([tallies[i].moment.observation for i in running]).astype(np.float32)
        actions = decode_actions(spec, policy(observations), len(running))
        for i, action in zip(running, actions, strict=True):
            tallies[i].add(spec, action, episodes[i].step(action))
        running = [i for i in running if not tallies[i].moment.terminated]
        if progress is not None:
            progress(step / limit if running else 1.0, len(episodes) - len(running))
        if not running:
            break


def _start(episode: Episode, settings: EvaluationSettings, index: int) -> Moment:
    seed = settings.first_seed + index
    rng = np.random.default_rng(seed)
    if settings.perturb > 0:
        episode.perturb(rng, settings.perturb)
    if settings.wide or settings.start_scale != 1:
        return episode.place(draw(episode.spec, rng, wide=settings.wide, scale=settings.start_scale))
    return episode.reset(seed)


def _account(spec: EnvironmentSpec, tallies: list[_Tally], start: Array) -> Evaluation:
    first = tallies[0]
    success = None if spec.success is None else np.array([_succeeds(spec.success, t) for t in tallies])
    return Evaluation(
        returns=np.array([t.total for t in tallies]),
        lengths=np.array([t.length for t in tallies], dtype=np.int64),
        success=success,
        trace=Trace(np.stack([start, *first.path]), np.stack(first.actions), np.array(first.rewards)),
    )


def _holds(spec: EnvironmentSpec, coordinates: Array) -> bool:
    if spec.success is None:
        return False
    return all(bool(holds(spec, inequality, coordinates[None])[0]) for inequality in spec.success.hold)


def _succeeds(success: Success, tally: _Tally) -> bool:
    """Every criterion that is given."""
    return (
        (not success.hold or tally.held >= success.hold_steps)
        and (success.min_steps is None or tally.length >= success.min_steps)
        and (success.terminated is None or tally.moment.terminated == success.terminated)
        and (success.min_return is None or tally.total >= success.min_return)
    )
