"""SurrogateVectorEnv: the lanes of a session as a tianshou vector environment."""

from __future__ import annotations

from functools import partial
from typing import Any, Self

from tianshou.env import BaseVectorEnv
from tianshou.env.worker import EnvWorker

from surrogym_client.environments.lane_calls import LaneCalls, Started, Stepped
from surrogym_client.environments.lanes import Lanes, session_request
from surrogym_client.environments.spaces import space
from surrogym_client.transport.http_surrogate import HttpSurrogate, Retries, Timeouts, Transport
from surrogym_shared.port import SurrogatePort
from surrogym_shared.wire import SessionView


class SurrogateVectorEnv(BaseVectorEnv):  # type: ignore[misc]  # tianshou is not installed where types are checked
    """Vector environment of tianshou whose lanes are virtual environments of one surrogate, stepped in one request.

    Infos are those of ``RemoteEnv``. ``seed`` takes effect at the next reset.

    Args:
        url: the server's address; None takes ``SURROGYM_URL``, then http://127.0.0.1:8000.
        surrogate: name of the surrogate.
        num_envs: number of lanes, N.
        token: bearer token; default ``SURROGYM_TOKEN``.
        timeouts: seconds for each kind of request.
        retries: how long to retry after lost connections, lost replies and status 503.
        transport: how steps travel; see ``HttpSurrogate``.
        options: fields of ``OpenSession``: variant, seed, model, time_limit, penalty, ...

    Raises:
        TypeError: an unknown option.
        ValueError: an option is out of range.
        SurrogymClientError: the session can't be opened.

    Examples:
        >>> Collector(policy, SurrogateVectorEnv("http://127.0.0.1:8000", "pendulum", num_envs=16))
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
        """Make the vector environment from an existing port, such as one in this process."""
        env = cls.__new__(cls)
        env._open(port, num_envs, options)
        return env

    def _open(self, port: SurrogatePort, num_envs: int, options: dict[str, Any]) -> None:
        self._lanes = Lanes(port, session_request(num_envs, "disabled", options))
        calls = LaneCalls(self._lanes)
        makers = [partial(_Lane, calls, lane, self._lanes.view) for lane in range(num_envs)]
        super().__init__(makers, lambda make: make())

    def close(self) -> None:
        super().close()
        self._lanes.close()


class _Lane(EnvWorker):  # type: ignore[misc]  # as above
    """One lane in the form of tianshou's environment worker."""

    def __init__(self, calls: LaneCalls, lane: int, view: SessionView) -> None:
        self._calls, self._lane = calls, lane
        self._seed: int | None = None
        self._attributes: dict[str, Any] = {
            "observation_space": space(view.observation_space),
            "action_space": space(view.action_space),
            "metadata": {"render_modes": []},
            "render_mode": None,
            "spec": None,
        }
        super().__init__(None)

    def get_env_attr(self, key: str) -> Any:
        if key not in self._attributes:
            raise AttributeError(f"a lane of a surrogate has no attribute {key!r}")
        return self._attributes[key]

    def set_env_attr(self, key: str, value: Any) -> None:
        self._attributes[key] = value

    def send(self, action: Any, **kwargs: Any) -> None:
        """Note a step, or a reset if the action is None. A reset of a surrogate takes no options."""
        if action is None:
            self._calls.reset(self._lane, kwargs.get("seed", self._seed))
            self._seed = None
        else:
            self._calls.step(self._lane, action)

    def recv(self) -> Started | Stepped:
        return self._calls.answer(self._lane)

    def reset(self, **kwargs: Any) -> Started | Stepped:
        self.send(None, **kwargs)
        return self.recv()

    def seed(self, seed: int | None = None) -> Any:
        self._seed = seed
        return super().seed(seed)

    def render(self, **_: Any) -> None:
        """Refuse to render, because a lane has no render mode."""

    def close_env(self) -> None:
        """Do nothing: closing the vector environment closes the session."""
