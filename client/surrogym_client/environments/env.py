"""RemoteEnv: one lane of a surrogate as a Gymnasium environment."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, SupportsFloat

import gymnasium
import numpy as np
from numpy.typing import NDArray

from surrogym_client.environments.lanes import LaneReset, Lanes, LaneStep, session_request
from surrogym_client.environments.render_modes import RENDER_MODES, render_modes_of
from surrogym_client.environments.spaces import space
from surrogym_shared.port import SurrogatePort
from surrogym_shared.spec import EnvironmentSpec

if TYPE_CHECKING:
    from surrogym_client.environments.pictures import Picture, Pictures

LOST = "surrogym_session_lost"

Observation = NDArray[np.float32]


class RemoteEnv(gymnasium.Env[Observation, Any]):
    """Virtual environment of a surrogate, stepped like any Gymnasium environment.

    ``reset(seed=s)`` starts episode 0 of seed s, and ``reset()`` starts the next episode. The server applies the time
    limit, after which an episode is ``truncated``. ``info`` has ``model_version`` and, after a step, ``reward_mean``
    (the reward before the penalty) and, if requested, ``deviation`` (O,) of the O model outputs. In a session with the
    option ``trust``, ``untrusted`` is whether the episode was truncated because the model is too uncertain in its
    state. If the specification declares limits, or a reward outside of the sampling range, ``left`` is whether the
    episode ended where the fallback of the limits acts, or outside of the range. If the server loses the session, the
    episode is truncated with the reason in ``info["surrogym_session_lost"]``, and the next reset begins in a new
    session.

    Args:
        port: the interface of the surrogate.
        deviations: whether steps return the predicted standard deviation of each model output.
        render_mode: None, or rgb_array: the state is drawn by the original environment's renderer, if it is installed.
        original: ``package.module:factory`` of your own environment, for rendering.
        options: fields of ``OpenSession``: variant, seed, model, time_limit, penalty, ...

    Raises:
        TypeError: an unknown option.
        ValueError: an option is out of range.
        NotRenderable: no picture can be made.
        SurrogymClientError: the session can't be opened.

    Examples:
        >>> env = gymnasium.make("surrogym/Remote-v0", url="http://127.0.0.1:8000", surrogate="pendulum")
        >>> observation, info = env.reset(seed=0)
    """

    metadata: dict[str, Any] = {"render_modes": RENDER_MODES}  # noqa: RUF012  as gymnasium.Env declares it

    def __init__(
        self,
        port: SurrogatePort,
        *,
        deviations: bool = False,
        render_mode: str | None = None,
        original: str | None = None,
        **options: Any,
    ) -> None:
        request, spec = session_request(1, "disabled", options), port.spec()
        self.render_mode = render_mode
        self._pictures, self.metadata = drawn(spec, original, render_mode)
        self._shown: Observation | None = None
        self._lanes = Lanes(port, request, deviations=deviations)
        self.observation_space = space(self._lanes.view.observation_space)
        self.action_space = space(self._lanes.view.action_space)

    def reset(
        self,
        *,
        seed: int | None = None,
        options: dict[str, Any] | None = None,  # noqa: ARG002  a surrogate has no options of a reset
    ) -> tuple[Observation, dict[str, Any]]:
        super().reset(seed=seed)
        start = self._lanes.reset(seed)
        self._shown = start.observation[0]
        return self._shown, start_info(start, 0)

    def step(self, action: Any) -> tuple[Observation, SupportsFloat, bool, bool, dict[str, Any]]:
        step = self._lanes.step(np.asarray(action)[None])
        result = step.result
        terminated, truncated = bool(result.terminated[0]), bool(result.truncated[0])
        self._shown = result.observation[0]
        return self._shown, float(result.reward[0]), terminated, truncated, step_info(step, 0)

    def render(self) -> Picture | None:
        """Return a picture (height, width, 3) of the state that was observed last; None without a render mode."""
        return None if self._pictures is None else self._pictures.of(self._shown)

    def close(self) -> None:
        if self._pictures is not None:
            self._pictures.close()
        self._lanes.close()


def drawn(spec: EnvironmentSpec, original: str | None, mode: str | None) -> tuple[Pictures | None, dict[str, Any]]:
    """Return what draws observations of a surrogate in a render mode (None: nothing draws), and Gymnasium's
    ``metadata``: the render modes that work here, and the pictures' frames per second."""
    metadata: dict[str, Any] = {"render_modes": render_modes_of(spec, original)}
    if mode is None:
        return None, metadata
    from surrogym_client.environments.pictures import pictures_for

    pictures = pictures_for(mode, spec, original)
    return pictures, metadata | {"render_fps": pictures.frames_per_second}


def start_info(start: LaneReset, lane: int) -> dict[str, Any]:
    """Return Gymnasium's ``info`` of the reset of one lane."""
    info: dict[str, Any] = {"model_version": int(start.model_version[lane])}
    if start.lost is not None:
        info[LOST] = start.lost
    return info


def step_info(step: LaneStep, lane: int) -> dict[str, Any]:
    """Return Gymnasium's ``info`` of the step of one lane."""
    result = step.result
    info: dict[str, Any] = {
        "model_version": int(result.model_version[lane]),
        "reward_mean": float(result.reward_mean[lane]),
    }
    if result.deviation is not None:
        info["deviation"] = result.deviation[lane]
    if result.untrusted is not None:
        info["untrusted"] = bool(result.untrusted[lane])
    if result.left is not None:
        info["left"] = bool(result.left[lane])
    if step.cut[lane]:
        info[LOST] = step.lost
    return info
