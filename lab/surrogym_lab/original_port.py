"""The original environment in the place of a surrogate, for comparisons. Every step is real, and counted."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import count

import numpy as np

from surrogym_sampler.original.actions import decode_actions
from surrogym_sampler.original.episode import Episode, Moment
from surrogym_sampler.original.episodes import draw
from surrogym_sampler.original.errors import OriginalError
from surrogym_sampler.original.protocol import LONGEST_EPISODE, Array
from surrogym_shared.port import Bools, Floats, Ints, ResetResult, StepResult
from surrogym_shared.spec import BoxAction, DiscreteAction, EnvironmentSpec, MultiDiscreteAction
from surrogym_shared.terms import observe
from surrogym_shared.wire import (
    ActionSpace,
    BoxSpace,
    DiscreteSpace,
    MultiDiscreteSpace,
    OpenSession,
    SessionView,
    SubmittedOccupancy,
)

SEEDS = (2**20, 2**31)  # range of the seeds of resets, far from the seeds of evaluations


class NotParallel(OriginalError):
    """A second instance was requested of an environment that runs one at a time."""


class OriginalPort:
    """A ``SurrogatePort``, the interface of sessions that trainers use, whose episodes run in the original environment.
    Lanes are reset in the step that ends an episode (autoreset mode same_step), as in Stable-Baselines3.

    An environment that runs one instance at a time has one lane, in one session.

    Examples:
        >>> name = "Pendulum-v1"
        >>> spec = original.make(name).spec()
        >>> port = OriginalPort(spec, lambda: open_episode(name, spec, lambda: original.make(name)))
        >>> train(port, Path("oracle.zip"), TrainSettings(total_steps=100_000))
        >>> port.steps
    """

    def __init__(self, spec: EnvironmentSpec, open_episode: Callable[[], Episode]) -> None:
        self.steps = 0  # number of real steps in all sessions
        self._spec = spec
        self._open_episode = open_episode
        self._parallel = True  # whether several instances may exist, as the first one says once it is open
        self._sessions: dict[str, list[_Lane]] = {}
        self._names = count()

    def spec(self) -> EnvironmentSpec:
        """Return the specification of the environment."""
        return self._spec

    def open(self, request: OpenSession) -> SessionView:
        """Open a session of N lanes (environments that step together). Options that concern models only (variant,
        penalty, ...) are ignored.

        Raises:
            ValueError: another autoreset mode than same_step.
            NotParallel: several lanes, or a second session, of an environment that runs one instance at a time.
        """
        if request.autoreset_mode != "same_step":
            raise ValueError(
                "autoreset_mode: expected same_step, the only mode of an original environment, got "
                f"{request.autoreset_mode}"
            )
        name, seed = f"original-{next(self._names)}", request.seed or 0
        limit = request.time_limit or self._spec.time_limit or LONGEST_EPISODE
        self._check_alone(sum(map(len, self._sessions.values())))
        lanes = [
            _Lane(self._spec, self._open_episode, (seed, lane), request.start_box, limit)
            for lane in range(request.num_envs)
        ]
        self._parallel = lanes[0].instance().parallel
        self._sessions[name] = lanes
        try:
            self._check_alone(request.num_envs - 1)
        except NotParallel:
            self.close(name)
            raise
        return SessionView(
            id=name,
            surrogate=self._spec.environment,
            num_envs=request.num_envs,
            variant=request.variant,
            seed=seed,
            autoreset_mode=request.autoreset_mode,
            model="latest",
            model_version=[0] * request.num_envs,
            seq=0,
            time_limit=limit,
            penalty=0.0,
            observation_space=BoxSpace(
                low=[entry.low for entry in self._spec.observation],
                high=[entry.high for entry in self._spec.observation],
            ),
            action_space=_action_space(self._spec),
            outputs=[],
            idle_seconds=float("inf"),
        )

    def reset(self, session: str, *, seed: int | Sequence[int] | None = None, mask: Bools | None = None) -> ResetResult:
        """Begin new episodes in all lanes, or only in the lanes that ``mask`` (N,) marks."""
        lanes = self._lanes(session)
        for i, lane in enumerate(lanes):
            if mask is None or mask[i]:
                if seed is not None:
                    lane.seed((seed, i) if isinstance(seed, int) else (seed[i], 0))
                lane.begin()
        return ResetResult(_observations(lanes), np.zeros(len(lanes), dtype=np.int64))

    def step(
        self,
        session: str,
        action: Floats | Ints,
        *,
        mask: Bools | None = None,
        deviations: bool = False,  # noqa: ARG002  nothing is predicted here
    ) -> StepResult:
        """Take one real step in all lanes, or only in the lanes that ``mask`` (N,) marks. Lanes whose episode ends are
        reset."""
        lanes = self._lanes(session)
        reward, terminated, truncated = np.zeros(len(lanes)), *np.zeros((2, len(lanes)), dtype=np.bool_)
        final: dict[int, Array] = {}
        for i, (lane, taken) in enumerate(zip(lanes, decode_actions(self._spec, action, len(lanes)), strict=True)):
            if mask is not None and not mask[i]:
                continue
            moment = lane.step(taken)
            self.steps += 1
            reward[i], terminated[i] = moment.reward, moment.terminated
            truncated[i] = (lane.over or moment.truncated) and not moment.terminated
            if terminated[i] or truncated[i]:
                final[i] = moment.observation
                lane.begin()
        return StepResult(
            observation=_observations(lanes),
            reward=reward,
            terminated=terminated,
            truncated=truncated,
            final_lanes=np.array(list(final), dtype=np.int64),
            final_observation=np.array(list(final.values()), dtype=np.float32).reshape(-1, len(self._spec.observation)),
            model_version=np.zeros(len(lanes), dtype=np.int64),
            reward_mean=reward,
            deviation=None,
        )

    def rollout(self, session: str, actions: Floats | Ints) -> list[StepResult]:
        """Take T steps in all lanes, with actions (T, N, F)."""
        return [self.step(session, action) for action in actions]

    def submit_occupancy(self, session: str, checkpoint: str) -> SubmittedOccupancy:
        """Ignore the visited states of a policy, because the original environment has no design that could use them."""
        self._lanes(session)
        return SubmittedOccupancy(checkpoint=checkpoint, states=0)

    def close(self, session: str) -> None:
        """Close a session and its environments; closing it twice has no effect."""
        for lane in self._sessions.pop(session, []):
            lane.close()

    def _check_alone(self, others: int) -> None:
        if others and not self._parallel:
            raise NotParallel(
                f"expected one lane in one session, as the environment runs one instance at a time, got {others} "
                "further lanes: use one lane, or set the attribute parallel = True of a simulator that can "
                "run several times"
            )

    def _lanes(self, session: str) -> list[_Lane]:
        if session not in self._sessions:
            raise ValueError(f"expected an open session, got {session!r}, which is closed or unknown: open a session")
        return self._sessions[session]


class _Lane:
    """One of the environments that step together. It is made on first use, because many lanes are never stepped."""

    def __init__(
        self,
        spec: EnvironmentSpec,
        open_episode: Callable[[], Episode],
        seed: tuple[int, int],
        start_box: float,
        limit: int,
    ) -> None:
        self._spec = spec
        self._open_episode = open_episode
        self._start_box = start_box
        self._limit = limit
        self._episode: Episode | None = None
        self._placed: Array | None = None  # coordinates at which the next step begins; None continues the episode
        self._length = 0
        self.observation = np.zeros(len(spec.observation))
        self.seed(seed)

    def seed(self, seed: tuple[int, int]) -> None:
        self._rng = np.random.default_rng(seed)

    @property
    def over(self) -> bool:
        """Whether the time limit has been reached."""
        return self._length >= self._limit

    def begin(self) -> None:
        """Begin an episode: with probability ``start_box`` at a random state of the sampling range, else by the
        environment's reset."""
        self._length, self._placed = 0, None
        if self._rng.random() < self._start_box:
            self._placed = draw(self._spec, self._rng, wide=True)
            self.observation = observe(self._spec, self._placed[None])[0]
        else:
            self.observation = self.instance().reset(int(self._rng.integers(*SEEDS))).observation

    def step(self, action: Array) -> Moment:
        episode = self.instance()
        if self._placed is not None:
            episode.place(self._placed)
            self._placed = None
        moment = episode.step(action)
        self._length += 1
        self.observation = moment.observation
        return moment

    def close(self) -> None:
        if self._episode is not None:
            self._episode.close()

    def instance(self) -> Episode:
        """Return the lane's environment, which the first call makes."""
        if self._episode is None:
            self._episode = self._open_episode()
        return self._episode


def _observations(lanes: Sequence[_Lane]) -> Floats:
    stacked: Floats = np.stack([lane.observation for lane in lanes]).astype(np.float32)
    return stacked


def _action_space(spec: EnvironmentSpec) -> ActionSpace:
    match spec.action:
        case BoxAction(low=low, high=high, bins=None):
            return BoxSpace(low=list(low), high=list(high))
        case BoxAction(bins=(n,)) | DiscreteAction(n=n):
            return DiscreteSpace(n=n)
        case BoxAction(bins=counts) | MultiDiscreteAction(nvec=counts):
            return MultiDiscreteSpace(nvec=list(counts or ()))
