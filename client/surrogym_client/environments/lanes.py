"""N lanes (environments that step together) of one session, which continue if the server loses the session.

If the server loses a session (it crashed, or the session expired), the running episodes end as truncated at their last
observation, with the reason. New episodes start in a new session. Nothing is reset silently.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from surrogym_client.errors import SessionLost, SurrogymClientError
from surrogym_shared.port import (
    Bools,
    Floats,
    Ints,
    PolicyPort,
    PolicyRollout,
    ResetResult,
    StepResult,
    SurrogatePort,
)
from surrogym_shared.wire import AutoresetMode, OpenSession

if TYPE_CHECKING:
    from surrogym_shared.acting import ActingPolicy, NoiseKey

REOPENINGS = 3
OPTIONS = tuple(name for name in OpenSession.model_fields if name not in ("num_envs", "autoreset_mode"))


@dataclass(frozen=True)
class LaneReset:
    """Result of a reset. If the server had lost the session, ``lost`` is the reason, else None."""

    observation: Floats  # (N, D) observation of each lane
    model_version: Ints  # (N,) version of the model in each lane
    lost: str | None = None


@dataclass(frozen=True)
class LaneStep:
    """Result of a step, with facts about its episodes that each environment class reports in its own form."""

    result: StepResult
    began: Bools  # (N,) lanes that were reset instead of stepped (autoreset mode next_step); their action had no effect
    ended_under: Ints  # (N,) version of the model that computed the step
    cut: Bools  # (N,) lanes whose episode this step ends, because the server lost the session
    lost: str | None = None


def session_request(num_envs: int, mode: AutoresetMode, options: dict[str, Any]) -> OpenSession:
    """Build the request that opens a session.

    Raises:
        TypeError: an unknown option. The message is Python's for an unknown keyword, because trainers such as TorchRL's
            ``GymEnv`` try a keyword, ``frameskip``, and retry without it after this error.
        ValueError: an option is out of range.
    """
    for name in options:
        if name not in OPTIONS:
            from surrogym_shared.removed import remark  # imported late, because only an error needs it

            raise TypeError(
                f"got an unexpected keyword argument {name!r}: session options are {', '.join(OPTIONS)}"
                f"{remark('session option', name)}"
            )
    try:
        return OpenSession(num_envs=num_envs, autoreset_mode=mode, **options)
    except ValidationError as error:
        from surrogym_shared.faults import first_fault  # imported late, because only an error needs it

        raise ValueError(f"session options: {first_fault(error, got=True)}") from error


class Lanes:
    """The N lanes (environments that step together) of a session of a surrogate. Making the object opens the session.

    Args:
        port: the interface of the surrogate.
        request: options of the session.
        deviations: whether each step returns the predicted standard deviation of each output.
    """

    def __init__(self, port: SurrogatePort, request: OpenSession, *, deviations: bool = False) -> None:
        self.port = port
        self.view = port.open(request)
        self._request = request
        self._deviations = deviations
        # Whether ``rollout`` can be used.
        self.rolls_policies = request.autoreset_mode == "same_step" and isinstance(port, PolicyPort)
        self._seed = self.view.seed
        self._losses = 0
        self._reason = ""
        lanes = request.num_envs
        self._observation: Floats = np.zeros((lanes, len(self.view.observation_space.low)), dtype=np.float32)
        self._start = self._observation  # (N, D) first observations of the lanes in the present session
        self._version: Ints = np.array(self.view.model_version, dtype=np.int64)
        self._running = _none(lanes)
        # (N,) whether a lane's episode was lost with an earlier session, and is not reported as truncated yet.
        self._cut = _none(lanes)
        # (N,) whether a lane was reset when a new session was opened, and the step that reports the reset has not come.
        self._held = _none(lanes)

    @property
    def num_envs(self) -> int:
        return self._request.num_envs

    @property
    def penalised(self) -> bool:
        """Whether the session subtracts a penalty from rewards where the model is uncertain."""
        return self.view.penalty > 0

    @property
    def mode(self) -> AutoresetMode:
        return self._request.autoreset_mode

    def reset(self, seed: int | Sequence[int | None] | None = None, mask: Bools | None = None) -> LaneReset:
        """Start new episodes in all lanes, or only in those of the mask (N,). A lane whose seed is None begins its next
        episode.

        Raises:
            ValueError: the list of seeds has not N entries.
        """
        chosen = np.ones(self.num_envs, dtype=bool) if mask is None else mask
        try:
            result, lost = self._seeded(seed, mask), None
        except SessionLost as error:
            self._reopen(error)
            result, lost = self._seeded(seed, mask), self._reason
        self._observation = np.where(chosen[:, None], result.observation, self._observation)
        self._version = result.model_version
        self._running = self._running | chosen
        self._cut, self._held = self._cut & ~chosen, self._held & ~chosen
        return LaneReset(self._observation.copy(), self._version.copy(), lost)

    def step(self, action: NDArray[Any]) -> LaneStep:
        """Step all lanes with actions (N, F) or (N,)."""
        try:
            result = self._advance(action)
        except SessionLost as error:
            self._reopen(error)
            result = self._standing()
        began = _none(self.num_envs) if self.mode == "same_step" else ~self._running
        cut, self._cut, self._held = self._cut, _none(self.num_envs), _none(self.num_envs)
        if cut.any():
            result = self._ended(result, cut)
        step = LaneStep(result, began, self._version, cut, self._reason if cut.any() else None)
        self._version = result.model_version
        self._observation = result.observation
        self._running = ~(result.terminated | result.truncated) | (self.mode == "same_step")
        return step

    def rollout(
        self, policy: ActingPolicy, steps: int, noise: NoiseKey | None = None, until: Bools | None = None
    ) -> PolicyRollout | None:
        """Step all lanes at most ``steps`` times with a policy, in one request.

        Returns None if the server lost the session. Then no step was taken, and the next ``step`` ends the episodes.

        Args:
            policy: the policy.
            steps: largest number of steps.
            noise: key of the actions' random noise; None takes the most probable actions.
            until: mask (N,) of lanes; the rollout stops once an episode has ended in each of them.
        """
        assert isinstance(self.port, PolicyPort)
        if not self._cut.any():
            try:
                rollout = self.port.rollout_policy(self.view.id, policy, steps, noise=noise, until=until)
            except SessionLost as error:
                self._reopen(error)
            else:
                self._observation, self._version = rollout.observation[-1], rollout.model_version[-1]
                return rollout
        return None

    def close(self) -> None:
        """Close the session. A session that the server no longer has is no error."""
        with suppress(SurrogymClientError):
            self.port.close(self.view.id)

    def _seeded(self, seed: int | Sequence[int | None] | None, mask: Bools | None) -> ResetResult:
        if seed is None or isinstance(seed, int | np.integer):
            return self.port.reset(self.view.id, seed=seed, mask=mask)
        if len(seed) != self.num_envs:
            raise ValueError(
                f"seed: expected one number, or a list of {self.num_envs} for the lanes, got a list of {len(seed)}"
            )
        chosen = np.ones(self.num_envs, dtype=bool) if mask is None else mask
        seeded = chosen & [s is not None for s in seed]
        if (chosen & ~seeded).any():
            result = self.port.reset(self.view.id, mask=chosen & ~seeded)
        if seeded.any():
            numbers = [0 if s is None else int(s) for s in seed]
            result = self.port.reset(self.view.id, seed=numbers, mask=None if seeded.all() else seeded)
        return result

    def _advance(self, action: NDArray[Any]) -> StepResult:
        idle = self._cut | self._held
        if idle.all():
            return self._standing()
        mask = ~idle if idle.any() else None
        return self.port.step(self.view.id, action, mask=mask, deviations=self._deviations)

    def _standing(self) -> StepResult:
        """Return the result of a step in which no lane moves: each lane repeats its last observation, or the first one
        of a new session that has reset the lane."""
        lanes, size = self._observation.shape
        return StepResult(
            observation=np.where(self._held[:, None], self._start, self._observation),
            reward=np.zeros(lanes),
            terminated=_none(lanes),
            truncated=_none(lanes),
            final_lanes=np.zeros(0, dtype=np.int64),
            final_observation=np.zeros((0, size), dtype=np.float32),
            model_version=np.array(self.view.model_version, dtype=np.int64),
            reward_mean=np.zeros(lanes),
            deviation=None,
        )

    def _ended(self, result: StepResult, cut: Bools) -> StepResult:
        """End the episodes of the lanes in ``cut`` as truncated, in the form of the session's autoreset mode."""
        if self.mode == "same_step":
            lanes = np.concatenate([result.final_lanes, np.flatnonzero(cut)])
            final = np.concatenate([result.final_observation, self._observation[cut]])
            shown = self._start
            result = replace(result, final_lanes=lanes, final_observation=final)
        else:
            shown = self._observation
        if self.mode == "next_step":
            self._held = cut
        return replace(
            result,
            observation=np.where(cut[:, None], shown, result.observation),
            truncated=result.truncated | cut,
        )

    def _reopen(self, error: SessionLost, attempts: int = REOPENINGS) -> None:
        """Open a session in place of the lost one, and, if lanes reset automatically, begin their new episodes.

        The new seed is derived from the first session's seed and the number of losses. So the starts differ, and are
        repeatable.
        """
        self._losses += 1
        seed = int(np.random.SeedSequence([self._seed, self._losses]).generate_state(1, np.uint64)[0] >> np.uint64(1))
        view = self.port.open(self._request.model_copy(update={"seed": seed, "idempotency_key": None}))
        if self.mode != "disabled":
            try:
                self._start = self.port.reset(view.id).observation
            except SessionLost as again:
                if attempts == 1:
                    raise
                return self._reopen(again, attempts - 1)
        self.view, self._reason = view, str(error)
        self._cut = self._running
        self._held = ~self._running & (self.mode == "next_step")
        return None


def _none(num_envs: int) -> Bools:
    return np.zeros(num_envs, dtype=bool)
