"""SurrogateVecEnv: the lanes of a session as a Stable-Baselines3 vector environment."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Self

import gymnasium
import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.vec_env.base_vec_env import VecEnv, VecEnvIndices, VecEnvStepReturn

from surrogym_client.environments.env import LOST
from surrogym_client.environments.lanes import Lanes, LaneStep, session_request
from surrogym_client.environments.spaces import space
from surrogym_client.transport import HttpSurrogate, Retries, Timeouts, Transport
from surrogym_shared.port import SurrogatePort
from surrogym_shared.wire import SubmittedOccupancy


class SurrogateVecEnv(VecEnv):
    """Vector environment of Stable-Baselines3 whose lanes are virtual environments of one surrogate.

    Infos have ``TimeLimit.truncated``, ``model_version`` and ``reward_mean``, and at the end of an episode
    ``terminal_observation``. In a session with a penalty, the last info of an episode has ``penalty``: the amount it
    subtracted from the episode's return. In a session with the option ``trust``, ``untrusted`` says whether the episode
    was truncated because the model is too uncertain in its state. An episode that ends because the server lost the
    session is truncated, with the reason in ``surrogym_session_lost``.

    Args:
        url: the server's address; None takes ``SURROGYM_URL``, then http://127.0.0.1:8000.
        surrogate: name of the surrogate.
        num_envs: number of lanes, N.
        token: bearer token; default ``SURROGYM_TOKEN``, then the one in the file ``SURROGYM_TOKEN_FILE``.
        timeouts: seconds for each kind of request.
        retries: how long to retry after lost connections, lost replies and status 503.
        transport: how steps travel; see ``HttpSurrogate``.
        options: fields of ``OpenSession``: variant, seed, model, time_limit, penalty, occupancy, ...

    Raises:
        TypeError: an unknown option.
        ValueError: an option is out of range.
        SurrogymClientError: the session can't be opened.

    Examples:
        >>> PPO("MlpPolicy", SurrogateVecEnv("http://127.0.0.1:8000", "pendulum", num_envs=16)).learn(100_000)
    """

    def __init__(
        self,
        url: str | None,
        surrogate: str,
        num_envs: int = 16,
        *,
        token: str | None = None,
        timeouts: Timeouts | None = None,
        retries: Retries | None = None,
        transport: Transport = "auto",
        **options: Any,
    ) -> None:
        port = HttpSurrogate(url, surrogate, token, timeouts=timeouts, retries=retries, transport=transport)
        self._open(port, num_envs, options)

    @classmethod
    def from_port(cls, port: SurrogatePort, num_envs: int = 16, **options: Any) -> Self:
        """Make the vector environment from an interface of a surrogate (port), such as that of a surrogate in this
        process."""
        env = cls.__new__(cls)
        env._open(port, num_envs, options)
        return env

    def _open(self, port: SurrogatePort, num_envs: int, options: dict[str, Any]) -> None:
        self.port = port
        self._lanes = Lanes(port, session_request(num_envs, "same_step", options))
        self._attributes: list[dict[str, Any]] = [{"render_mode": None} for _ in range(num_envs)]
        view = self._lanes.view
        super().__init__(num_envs, space(view.observation_space), space(view.action_space))
        self._actions: NDArray[Any] | None = None
        self._penalty = np.zeros(num_envs)  # (N,) sum of the penalties for uncertainty in each running episode

    @property
    def session(self) -> str:
        """Id of the session. It changes if the session is lost and opened again."""
        return self._lanes.view.id

    def submit_occupancy(self, checkpoint: str) -> SubmittedOccupancy:
        """Submit the states that were visited since the session was opened, under the name ``checkpoint``, which may be
        any name.

        The design can then choose queries near these states. Returns the number of states, and the confidence index of
        the model at them.
        """
        return self.port.submit_occupancy(self.session, checkpoint)

    def reset(self) -> NDArray[Any]:
        given = any(seed is not None for seed in self._seeds)
        start = self._lanes.reset(self._seeds if given else None)
        self._penalty = np.zeros(self.num_envs)
        self.reset_infos = [{"model_version": int(version)} for version in start.model_version]
        if start.lost is not None:
            for info in self.reset_infos:
                info[LOST] = start.lost
        self._reset_seeds()
        self._reset_options()
        return start.observation

    def step_async(self, actions: NDArray[Any]) -> None:
        self._actions = np.asarray(actions)

    def step_wait(self) -> VecEnvStepReturn:
        if self._actions is None:
            raise RuntimeError(
                "expected a call of step_async before step_wait, got none: call step_async with the actions"
            )
        step, self._actions = self._lanes.step(self._actions), None
        result = step.result
        done = result.terminated | result.truncated
        for lane in result.final_lanes:
            self.reset_infos[lane] = {"model_version": int(result.model_version[lane])}
        infos = _infos(step)
        if self._lanes.penalised:
            self._penalty += result.reward_mean - result.reward
            for lane in np.flatnonzero(done):
                infos[lane]["penalty"] = float(self._penalty[lane])
            self._penalty[done] = 0
        return result.observation.copy(), result.reward.astype(np.float32), done, infos

    def close(self) -> None:
        self._lanes.close()

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        return [self._attribute(lane, attr_name) for lane in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        for lane in self._get_indices(indices):
            self._attributes[lane][attr_name] = value

    def env_method(
        self, method_name: str, *method_args: Any, indices: VecEnvIndices = None, **method_kwargs: Any
    ) -> list[Any]:
        return [
            self._attribute(lane, method_name)(*method_args, **method_kwargs) for lane in self._get_indices(indices)
        ]

    def env_is_wrapped(
        self,
        wrapper_class: type[gymnasium.Wrapper[Any, Any, Any, Any]],  # noqa: ARG002
        indices: VecEnvIndices = None,
    ) -> list[bool]:
        return [False for _ in self._get_indices(indices)]

    def get_images(self) -> Sequence[NDArray[Any] | None]:
        return [None] * self.num_envs

    def _attribute(self, lane: int, name: str) -> Any:
        """Return an attribute of a lane: the lane's own value, or else the value that all lanes share."""
        known = self._attributes[lane]
        if name in known:
            return known[name]
        if name in ("observation_space", "action_space", "metadata"):
            return getattr(self, name)
        raise AttributeError(f"a lane of a surrogate has no attribute {name!r}: add it by set_attr")


def _infos(step: LaneStep) -> list[dict[str, Any]]:
    result = step.result
    infos = [
        {"TimeLimit.truncated": truncated and not terminated, "model_version": version, "reward_mean": mean}
        for truncated, terminated, version, mean in zip(
            result.truncated.tolist(),
            result.terminated.tolist(),
            step.ended_under.tolist(),
            result.reward_mean.tolist(),
            strict=True,
        )
    ]
    for lane, observation in zip(result.final_lanes.tolist(), result.final_observation, strict=True):
        infos[lane]["terminal_observation"] = observation
    if result.untrusted is not None:
        for info, untrusted in zip(infos, result.untrusted.tolist(), strict=True):
            info["untrusted"] = untrusted
    if result.left is not None:
        for info, left in zip(infos, result.left.tolist(), strict=True):
            info["left"] = left
    for lane in np.flatnonzero(step.cut).tolist():
        infos[lane][LOST] = step.lost
    return infos
