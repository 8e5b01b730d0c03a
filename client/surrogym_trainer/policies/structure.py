"""A description of a policy as data, from which a policy of ``surrogym train`` is rebuilt without unpickling.

Stable-Baselines3 pickles what JSON can't represent: spaces, classes, schedules. The file of a policy gets an entry that
describes these objects, and reading rebuilds them from it. Weights are read as plain numbers. Nothing is unpickled.

Stable-Baselines3 makes every entry of a file an attribute of the algorithm, even a method. Only the entries that
``PolicySettings`` lists are accepted, each of its type. All others are ignored, and the algorithm's defaults apply.
"""

from __future__ import annotations

import io
import json
import math
import zipfile
from collections.abc import Mapping
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import torch
from gymnasium import Space, spaces
from pydantic import BaseModel, ConfigDict, Field, ValidationError
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.type_aliases import TrainFreq
from stable_baselines3.common.utils import ConstantSchedule, FloatSchedule
from stable_baselines3.dqn.policies import DQNPolicy
from stable_baselines3.sac.policies import SACPolicy
from stable_baselines3.td3.policies import TD3Policy
from torch.optim import RMSprop

from surrogym_client.environments.spaces import space
from surrogym_shared.archives import read_entries, stored
from surrogym_shared.faults import first_fault
from surrogym_shared.wire import ActionSpace, BoxSpace, DiscreteSpace, MultiDiscreteSpace
from surrogym_trainer.policies.defaults import decaying
from surrogym_trainer.policies.networks import PaperPolicy, Standardise

MAX_EXPERIENCE_BYTES = 2 * 1024**3
Count = Annotated[int, Field(ge=0, le=2**53)]
Positive = Annotated[int, Field(ge=1, le=2**53)]
Batch = Annotated[int, Field(ge=1, le=2**20)]
# Number of passes over the experience, or of gradient steps; -1 means one for each environment step.
Passes = Annotated[int, Field(ge=-1, le=10_000)]
Share = Annotated[float, Field(ge=0, le=1)]


class ReplaySettings(BaseModel):
    """The accepted settings of the replay buffer; its other settings follow from those of the algorithm."""

    model_config = ConfigDict(extra="ignore", frozen=True, strict=True)

    handle_timeout_termination: bool | None = None


class PolicySettings(BaseModel):
    """The accepted entries of a policy's file, named as the algorithm's attributes. None or a missing entry means the
    default."""

    model_config = ConfigDict(extra="ignore", frozen=True, strict=True, allow_inf_nan=False)

    seed: Annotated[int, Field(ge=0, lt=2**32)] | None = None
    gamma: Share | None = None
    learning_rate: Annotated[float, Field(ge=0)] | None = None
    max_grad_norm: float | None = None
    use_sde: bool | None = None
    sde_sample_freq: Annotated[int, Field(ge=-1)] | None = None
    use_sde_at_warmup: bool | None = None
    stats_window_size: Annotated[Batch | None, Field(alias="_stats_window_size")] = None
    # Settings of the stored experience.
    n_steps: Positive | None = None
    buffer_size: Positive | None = None
    optimize_memory_usage: bool | None = None
    replay_buffer_kwargs: ReplaySettings | None = None
    batch_size: Batch | None = None
    # Settings of PPO and A2C.
    n_epochs: Annotated[int, Field(ge=1, le=10_000)] | None = None
    gae_lambda: Share | None = None
    vf_coef: float | None = None
    normalize_advantage: bool | None = None
    target_kl: float | None = None
    # Settings of SAC, TD3, DDPG and DQN.
    ent_coef: float | Annotated[str, Field(pattern=r"^auto(_[0-9.e+-]+)?$", max_length=32)] | None = None
    target_entropy: float | None = None
    learning_starts: Count | None = None
    tau: Share | None = None
    gradient_steps: Passes | None = None
    target_update_interval: Positive | None = None
    policy_delay: Positive | None = None
    target_noise_clip: float | None = None
    target_policy_noise: float | None = None
    exploration_initial_eps: Share | None = None
    exploration_final_eps: Share | None = None
    exploration_fraction: Share | None = None
    exploration_rate: Share | None = None
    # Counters of the training's progress.
    num_timesteps: Count | None = None
    total_timesteps: Annotated[Count | None, Field(alias="_total_timesteps")] = None
    steps_at_start: Annotated[Count | None, Field(alias="_num_timesteps_at_start")] = None
    progress_remaining: Annotated[float | None, Field(alias="_current_progress_remaining")] = None
    episodes: Annotated[Count | None, Field(alias="_episode_num")] = None
    updates: Annotated[Count | None, Field(alias="_n_updates")] = None
    calls: Annotated[Count | None, Field(alias="_n_calls")] = None

    @property
    def attributes(self) -> dict[str, Any]:
        """The attributes that the file sets on the algorithm, by name."""
        return self.model_dump(by_alias=True, exclude_none=True)

    def require_memory(
        self, num_envs: int, observation_space: spaces.Space[Any], action_space: spaces.Space[Any]
    ) -> None:
        """Check that the transitions that the algorithm stores for learning (its experience) fit in
        ``MAX_EXPERIENCE_BYTES`` bytes.

        Raises:
            ValueError: they need more memory.
        """
        # 4 further numbers in each step: the reward, the end, the value and the like
        numbers = 2 * _size(observation_space) + _size(action_space) + 4
        steps = max(self.buffer_size or 0, (self.n_steps or 0) * num_envs)
        if (needed := 4 * numbers * steps) > MAX_EXPERIENCE_BYTES:
            asked = f"n_steps={self.n_steps}, buffer_size={self.buffer_size}, {num_envs} lanes"
            raise ValueError(
                f"expected at most {MAX_EXPERIENCE_BYTES} bytes of experience, got {needed} ({asked}): lower these "
                "settings"
            )


def _size(space: spaces.Space[Any]) -> int:
    return math.prod(space.shape or ())


ENTRY = "surrogym-policy.json"
MAX_BYTES = 256 * 1024 * 1024  # largest total size of the unpacked entries of a policy's file
WEIGHTS = ".pth"
PICKLED = ":serialized:"
DECAYING = "decaying"
POLICIES = {kind.__name__: kind for kind in (PaperPolicy, SACPolicy, TD3Policy, DQNPolicy)}
EXTRACTOR = {"features_extractor_class", "features_extractor_kwargs"}
OPTIMIZER = {"optimizer_class", "optimizer_kwargs"}
DESCRIBED = EXTRACTOR | OPTIMIZER | {"net_arch", "n_critics", "use_sde"}
NEEDED = ("policy_class", "policy_kwargs", "observation_space", "action_space")
# Attributes that Stable-Baselines3 makes itself, when it builds the algorithm or begins to learn.
REMADE = (
    *("lr_schedule", "exploration_schedule", "rollout_buffer_class", "replay_buffer_class"),
    *("_last_obs", "_last_original_obs", "_last_episode_starts", "ep_info_buffer", "ep_success_buffer"),
)
VARIABLES = {"log_ent_coef"}  # names of tensors outside of the network: SAC's entropy coefficient
IDLE = {"learning_rate": 0.0, "clip_range": 0.2, "clip_range_vf": None, "train_freq": 1, "action_noise": None}

Layers = Annotated[list[Annotated[int, Field(ge=1)]], Field(max_length=64)]


class PickledObjects(ValueError):
    """The file contains pickled objects without a description; ``names`` lists them."""

    def __init__(self, names: list[str]) -> None:
        super().__init__(names)
        self.names = names


class Structure(BaseModel):
    """A description of everything besides the weights that Stable-Baselines3 needs for a policy.

    ``learning_rate``, ``clip_range``, ``clip_range_vf`` and ``train_freq`` are only needed for learning; None means not
    described.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    version: Literal[1] = 1
    policy: Literal["PaperPolicy", "SACPolicy", "TD3Policy", "DQNPolicy"]
    observation_space: BoxSpace
    action_space: ActionSpace
    net_arch: Layers | dict[Literal["pi", "vf", "qf"], Layers]
    n_critics: Annotated[int, Field(ge=1, le=8)] | None = None
    use_sde: bool | None = None
    # settings of A2C's optimizer; other algorithms have Adam
    rmsprop: dict[Literal["alpha", "eps", "weight_decay"], float] | None = None
    learning_rate: Literal["decaying"] | None = None
    clip_range: float | None = None
    clip_range_vf: float | None = None
    train_freq: tuple[int, Literal["step", "episode"]] | None = None

    def objects(self) -> dict[str, Any]:
        """Return the attributes of the algorithm that the description contains, by name."""
        chosen = {
            "features_extractor_class": Standardise,
            "net_arch": self.net_arch,
            "n_critics": self.n_critics,
            "use_sde": self.use_sde,
            "optimizer_class": None if self.rmsprop is None else RMSprop,
            "optimizer_kwargs": self.rmsprop,
        }
        found = {
            "policy_class": POLICIES[self.policy],
            "policy_kwargs": _given(chosen),
            "observation_space": space(self.observation_space),
            "action_space": space(self.action_space),
            "learning_rate": decaying if self.learning_rate == DECAYING else None,
            "clip_range": self.clip_range,
            "clip_range_vf": self.clip_range_vf,
            "train_freq": self.train_freq,
        }
        return _given(found)

    @property
    def weights(self) -> int:
        """Smallest number of weights, without biases, of a network with the described layers."""
        inputs, arch = len(self.observation_space.low), self.net_arch
        parts = {"pi": arch} if isinstance(arch, list) else dict(arch)
        actor, others = parts.pop("pi", []), parts.values()
        chains = [(inputs, *actor, _outputs(self.action_space)), *((inputs, *layers) for layers in others)]
        return sum(a * b for chain in chains for a, b in pairwise(chain))


def save(learner: BaseAlgorithm, path: Path) -> None:
    """Save a policy as ``learner.save`` does. If possible, add a description from which the file is read without
    unpickling."""
    file = io.BytesIO()
    # The entry ``_last_original_obs`` is left out, because in a saved policy it means that VecNormalize normalised the
    # observations. Here it normalised only the rewards.
    learner.save(file, exclude=["_last_original_obs"])
    if (structure := describe(learner)) is not None:
        with zipfile.ZipFile(file, "a") as archive:
            archive.writestr(ENTRY, structure.model_dump_json())
    path.write_bytes(file.getvalue())


def describe(learner: BaseAlgorithm) -> Structure | None:
    """Return the description of a policy made by ``surrogym train``; None for any other policy."""
    kwargs, kind = learner.policy_kwargs, type(learner.policy)
    if POLICIES.get(kind.__name__) is not kind or set(kwargs) - DESCRIBED:
        return None
    if kwargs.get("features_extractor_class") is not Standardise:
        return None
    if kwargs.get("optimizer_class", RMSprop) is not RMSprop:
        return None
    observed, acted = _wire(learner.observation_space), _wire(learner.action_space)
    if not isinstance(observed, BoxSpace) or acted is None:
        return None
    return Structure(
        policy=kind.__name__,
        observation_space=observed,
        action_space=acted,
        net_arch=learner.policy.net_arch,
        n_critics=kwargs.get("n_critics"),
        use_sde=kwargs.get("use_sde"),
        rmsprop=kwargs.get("optimizer_kwargs"),
        learning_rate=DECAYING if learner.learning_rate is decaying else None,
        clip_range=_constant(learner, "clip_range"),
        clip_range_vf=_constant(learner, "clip_range_vf"),
        train_freq=_frequency(getattr(learner, "train_freq", None)),
    )


def read(path: Path, *, num_envs: int, replaced: set[str]) -> tuple[io.BytesIO, dict[str, Any]]:
    """Read a policy's file without its pickled objects, and rebuild these from the description.

    The results are arguments for ``load`` of a Stable-Baselines3 algorithm: the file, and ``custom_objects``.

    Args:
        path: file from ``save``.
        num_envs: number of environments in which the algorithm will continue to learn; 0 if it only acts, which leaves
            out the objects that only learning needs.
        replaced: attributes that the caller sets, so that the file's are not needed.

    Raises:
        PickledObjects: a needed object is neither described nor replaced.
        OSError: the file can't be read.
        ValueError: the file does not have this form.
    """
    entries = read_entries(path, MAX_BYTES)
    data = dict(json.loads(_entry(entries, "data")))
    pickled = [name for name, value in data.items() if isinstance(value, dict) and PICKLED in value]
    structure = Structure.model_validate_json(entries[ENTRY]) if ENTRY in entries else None
    objects: dict[str, Any] = dict.fromkeys((*REMADE, *replaced)) | ({} if num_envs else IDLE)
    if structure is not None:
        _require_weights(structure, _entry(entries, "policy" + WEIGHTS))
        objects |= structure.objects()
    if unknown := [name for name in pickled if name not in objects]:
        raise PickledObjects(unknown)
    settings = _settings(data, {*objects, *pickled, *NEEDED})
    if num_envs and structure is not None:
        settings.require_memory(num_envs, objects["observation_space"], objects["action_space"])
    # `load` replaces these placeholders by the objects
    placeholders = dict.fromkeys(({*pickled} - replaced) | {*NEEDED})
    data = {"verbose": 0, **settings.attributes, **placeholders}
    weights = {name: _plain(content) for name, content in entries.items() if name.endswith(WEIGHTS)}
    _require_variables(weights.get("pytorch_variables" + WEIGHTS))
    return io.BytesIO(stored({"data": json.dumps(data).encode(), **weights})), objects


def _settings(data: Mapping[str, Any], replaced: set[str]) -> PolicySettings:
    """Return the settings in a policy's file, except those that the caller or the description replaces."""
    try:
        return PolicySettings.model_validate({name: value for name, value in data.items() if name not in replaced})
    except ValidationError as error:
        raise ValueError(
            f"expected valid settings in the entry data of the policy's file, got this fault: "
            f"{first_fault(error, got=True)}; save the policy again"
        ) from error


def _entry(entries: Mapping[str, bytes], name: str) -> bytes:
    if name not in entries:
        raise ValueError(
            f"expected an entry {name!r} in the policy's file, got {', '.join(sorted(entries)[:5]) or 'none'}: "
            "save the policy again"
        )
    return entries[name]


def _plain(weights: bytes) -> bytes:
    """Return a zip that ``torch.save`` wrote, rewritten without compression after a check of its size, so that torch
    inflates nothing."""
    return stored(read_entries(weights, len(weights)))


def _require_weights(structure: Structure, file: bytes) -> None:
    """Raise ``ValueError`` if the described layers are far larger than the weights in the file: they would fill the
    memory before torch compares them."""
    came = len(file) // np.dtype(np.float32).itemsize
    if structure.weights > came:
        raise ValueError(
            f"expected the file to have {structure.weights} weights for its described layers, got at most {came}: "
            "save the policy again"
        )


def _require_variables(file: bytes | None) -> None:
    """Raise ``ValueError`` if a file has unknown tensors, because Stable-Baselines3 sets each one wherever in the
    algorithm its name points to."""
    found = {} if file is None else torch.load(io.BytesIO(file), map_location="cpu", weights_only=True)
    if unknown := {*(found or {})} - VARIABLES:
        raise ValueError(
            f"expected no other variables than {', '.join(VARIABLES)} in the policy's file, got "
            f"{', '.join(map(str, unknown))}: save the policy again"
        )


def _given(values: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in values.items() if value is not None}


def _outputs(action: BoxSpace | DiscreteSpace | MultiDiscreteSpace) -> int:
    match action:
        case BoxSpace():
            return len(action.low)
        case DiscreteSpace():
            return action.n
        case MultiDiscreteSpace():
            return sum(action.nvec)


def _wire(given: Space[Any]) -> BoxSpace | DiscreteSpace | MultiDiscreteSpace | None:
    """Return a space as data; None if it can't be rebuilt exactly."""
    described: BoxSpace | DiscreteSpace | MultiDiscreteSpace
    match given:
        case spaces.Box(shape=(_,)):
            low, high = ([float(x) if np.isfinite(x) else None for x in limits] for limits in (given.low, given.high))
            described = BoxSpace(low=low, high=high)
        case spaces.Discrete():
            described = DiscreteSpace(n=int(given.n))
        case spaces.MultiDiscrete():
            described = MultiDiscreteSpace(nvec=given.nvec.tolist())
        case _:
            return None
    return described if space(described) == given else None


def _constant(learner: BaseAlgorithm, name: str) -> float | None:
    match getattr(learner, name, None):
        case FloatSchedule(value_schedule=ConstantSchedule(val=value)):
            return float(value)
        case _:
            return None


def _frequency(given: object) -> tuple[int, Any] | None:
    return (given.frequency, given.unit.value) if isinstance(given, TrainFreq) else None
