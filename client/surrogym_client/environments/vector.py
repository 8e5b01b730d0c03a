"""RemoteVectorEnv: the lanes of a session as a Gymnasium vector environment, in all three autoreset modes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from surrogym_client.environments.env import LOST, Observation, drawn
from surrogym_client.environments.lanes import Lanes, LaneStep, session_request
from surrogym_client.environments.spaces import space
from surrogym_shared import wire
from surrogym_shared.port import Bools, SurrogatePort

if TYPE_CHECKING:
    from surrogym_client.environments.pictures import Picture

WIRE_MODE: dict[AutoresetMode, wire.AutoresetMode] = {
    AutoresetMode.NEXT_STEP: "next_step",
    AutoresetMode.SAME_STEP: "same_step",
    AutoresetMode.DISABLED: "disabled",
}


class RemoteVectorEnv(VectorEnv[Observation, NDArray[Any], NDArray[Any]]):
    """Vector environment of Gymnasium whose lanes are virtual environments of one surrogate, stepped in one request.

    Autoreset happens on the server. Observations, flags and infos are those of Gymnasium's ``SyncVectorEnv``:
    ``final_obs`` and ``final_info`` in the same-step mode, ``options={"reset_mask": mask}`` with autoreset disabled. An
    int seed s seeds lane i with the pair (s, i); a list has one seed for each lane. Infos are as in ``RemoteEnv``.

    Args:
        port: the interface of the surrogate.
        num_envs: number of lanes, N.
        autoreset_mode: Gymnasium's enum, or its value or name.
        deviations: whether steps return the predicted standard deviation of each model output.
        render_mode: None, or rgb_array: as in ``RemoteEnv``.
        original: ``package.module:factory`` of your own environment, for rendering.
        max_episode_steps: Gymnasium's name of the option ``time_limit``, as ``make_vec`` passes it.
        options: fields of ``OpenSession``: variant, seed, model, time_limit, penalty, ...

    Raises:
        TypeError: an unknown option.
        ValueError: an option is out of range.
        NotRenderable: no picture can be made.
        SurrogymClientError: the session can't be opened.

    Examples:
        >>> envs = gymnasium.make_vec("surrogym/Remote-v0", num_envs=8, surrogate="pendulum")
        >>> observations, infos = envs.reset(seed=0)
    """

    def __init__(
        self,
        port: SurrogatePort,
        num_envs: int = 1,
        *,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        deviations: bool = False,
        render_mode: str | None = None,
        original: str | None = None,
        max_episode_steps: int | None = None,
        **options: Any,
    ) -> None:
        mode = _mode(autoreset_mode)
        options = _with_time_limit(options, max_episode_steps)
        request, spec = session_request(num_envs, WIRE_MODE[mode], options), port.spec()
        self.num_envs = num_envs
        self.autoreset_mode = mode  # an attribute, as in SyncVectorEnv, because TorchRL reads it
        self.render_mode = render_mode
        self._pictures, metadata = drawn(spec, original, render_mode)
        self._shown: Observation | None = None
        self.metadata = {"autoreset_mode": mode, **metadata}
        self._lanes = Lanes(port, request, deviations=deviations)
        self.single_observation_space = space(self._lanes.view.observation_space)
        self.single_action_space = space(self._lanes.view.action_space)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

    def __len__(self) -> int:
        """Return the number of lanes, N."""
        return self.num_envs

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        if isinstance(seed, int):
            super().reset(seed=seed)
        mask = None if not options or "reset_mask" not in options else self._checked(options["reset_mask"])
        start = self._lanes.reset(seed, mask)
        chosen = np.ones(self.num_envs, dtype=bool) if mask is None else mask.copy()
        infos = _entry("model_version", start.model_version, chosen)
        if start.lost is not None:
            infos |= _reason(start.lost, chosen)
        self._shown = start.observation
        return start.observation, infos

    def step(
        self, actions: NDArray[Any]
    ) -> tuple[Observation, NDArray[Any], NDArray[Any], NDArray[Any], dict[str, Any]]:
        step = self._lanes.step(np.asarray(actions))
        result = step.result
        final = np.zeros(self.num_envs, dtype=bool)
        final[result.final_lanes] = True
        infos = self._final_infos(step, final) if final.any() else {}
        infos |= _entry("model_version", result.model_version, np.ones(self.num_envs, dtype=bool))
        infos |= _step_infos(step, ~(final | step.began))
        self._shown = result.observation
        return result.observation.copy(), result.reward, result.terminated, result.truncated, infos

    def render(self) -> tuple[Picture, ...] | None:
        """Return a picture (height, width, 3) of each lane; None without a render mode."""
        if self._pictures is None:
            return None
        shown = [None] if self._shown is None else self._shown
        return tuple(self._pictures.of(observation) for observation in shown)

    def close_extras(self, **_: Any) -> None:
        if self._pictures is not None:
            self._pictures.close()
        self._lanes.close()

    def _final_infos(self, step: LaneStep, final: Bools) -> dict[str, Any]:
        observations = np.full(self.num_envs, None, dtype=object)
        for lane, observation in zip(step.result.final_lanes, step.result.final_observation, strict=True):
            observations[lane] = observation
        info = _entry("model_version", step.ended_under, final) | _step_infos(step, final)
        return {
            "final_obs": observations,
            "_final_obs": final.copy(),
            "final_info": info,
            "_final_info": final.copy(),
        }

    def _checked(self, mask: Any) -> Bools:
        """Check the mask of a partial reset, and raise the same types of errors as Gymnasium does."""
        if not isinstance(mask, np.ndarray) or mask.dtype != np.bool_:
            found = f"dtype {mask.dtype}" if isinstance(mask, np.ndarray) else type(mask).__name__
            raise TypeError(f"options['reset_mask']: expected an array of dtype bool, got {found}")
        if mask.shape != (self.num_envs,) or not mask.any():
            raise ValueError(
                f"options['reset_mask']: expected shape ({self.num_envs},) with a True entry, got {mask!r}"
            )
        return mask


def _mode(mode: AutoresetMode | str) -> AutoresetMode:
    for known, name in WIRE_MODE.items():
        if mode in (known, known.value, name):
            return known
    raise ValueError(f"autoreset_mode: expected one of {list(WIRE_MODE.values())}, got {mode!r}")


def _with_time_limit(options: dict[str, Any], max_episode_steps: int | None) -> dict[str, Any]:
    if max_episode_steps is None:
        return options
    if options.get("time_limit") is not None:
        raise ValueError(
            "expected either time_limit or max_episode_steps, which mean the same, got both: leave one out"
        )
    return options | {"time_limit": max_episode_steps}


def _step_infos(step: LaneStep, lanes: Bools) -> dict[str, Any]:
    """Return Gymnasium's infos of a step, with values for the given lanes (N,) only."""
    if not lanes.any():
        return {}
    infos = _entry("reward_mean", step.result.reward_mean, lanes)
    if step.result.deviation is not None:
        infos |= _entry("deviation", step.result.deviation, lanes)
    if step.result.untrusted is not None:
        infos |= _entry("untrusted", step.result.untrusted, lanes)
    if step.result.left is not None:
        infos |= _entry("left", step.result.left, lanes)
    if step.lost is not None and (step.cut & lanes).any():
        infos |= _reason(step.lost, step.cut & lanes)
    return infos


def _entry(key: str, values: NDArray[Any], lanes: Bools) -> dict[str, Any]:
    """Return an entry of Gymnasium's infos: ``key`` has the values, 0 outside of the mask ``lanes`` (N,), and ``_key``
    has this mask."""
    shown = np.zeros_like(values)
    shown[lanes] = values[lanes]
    return {key: shown, f"_{key}": lanes.copy()}


def _reason(lost: str, lanes: Bools) -> dict[str, Any]:
    reasons = np.full(len(lanes), None, dtype=object)
    reasons[lanes] = lost
    return {LOST: reasons, f"_{LOST}": lanes.copy()}
