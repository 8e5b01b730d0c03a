"""Readers of policy files that run no code from them: those of Stable-Baselines3, networks of arrays, planners, and
ONNX.

The file of a policy of Stable-Baselines3 lacks the statistics with which ``VecNormalize`` normalised the
observations. They are read from a file of arrays beside it, because the file of ``VecNormalize.save`` is pickled.
"""

from __future__ import annotations

import pickle
import zipfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from surrogym_shared.network import Network
from surrogym_trainer.policies.card import DEFAULT_ALGORITHM, PolicyCard, UnusablePolicy, missing_policy, read_card
from surrogym_trainer.policies.onnx_files import load_onnx
from surrogym_trainer.policies.planner_files import PlannerFile
from surrogym_trainer.policies.predict import Predict

if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm

Floats = NDArray[np.float32]
ENDING = ".vecnormalize.npz"


def is_normalised(model: BaseAlgorithm) -> bool:
    """Return whether a policy learned with observations that ``VecNormalize`` normalised: then Stable-Baselines3 also
    stores the original observation. ``surrogym train`` normalises only rewards, and removes that entry from its
    files."""
    return getattr(model, "_last_original_obs", None) is not None


def statistics_path(policy: Path) -> Path:
    """Return the path of the statistics beside a policy, such as ``mine.vecnormalize.npz``."""
    return policy.with_suffix(ENDING)


def missing_statistics(policy: Path) -> UnusablePolicy:
    """Return the error for a policy without a file of its statistics, with the code that writes one."""
    arrays = "mean=env.obs_rms.mean, var=env.obs_rms.var, epsilon=env.epsilon, clip=env.clip_obs"
    return UnusablePolicy(
        f"{policy} learned in a VecNormalize, whose statistics are not in the file: expected them in "
        f'{statistics_path(policy)}; with env = VecNormalize.load(...), numpy.savez("{statistics_path(policy)}", '
        f"{arrays}) writes it (mean=0, var=1, epsilon=0, clip=numpy.inf if it normalised rewards only)"
    )


class Normalisation:
    """The normalisation of observations as in ``VecNormalize``: (o - mean) / sqrt(var + epsilon), clipped to +-clip."""

    def __init__(self, path: Path) -> None:
        """Read the statistics from a file. Raises ``UnusablePolicy`` if the file does not contain them."""
        try:
            with np.load(path, allow_pickle=False) as file:
                self.mean, variance, epsilon, self.clip = (
                    np.asarray(file[name], dtype=np.float64) for name in ("mean", "var", "epsilon", "clip")
                )
        except (OSError, ValueError, KeyError) as error:
            raise UnusablePolicy(
                f"{path}: expected the arrays mean, var, epsilon and clip ({error}): write the file again"
            ) from error
        self.spread = np.sqrt(variance + epsilon)

    def __call__(self, observations: Floats) -> Floats:
        """Return the normalised observations (N, D)."""
        scaled = (observations - self.mean) / self.spread
        return np.clip(scaled, -self.clip, self.clip).astype(np.float32)


# settings for loading a policy that only acts; they save memory, because it stores no experience
BUFFERLESS = {"n_envs": 1, "n_steps": 1, "buffer_size": 1}
# algorithms whose networks differ from each other; A2C has PPO's network, DDPG has TD3's
FAMILIES = ("PPO", "SAC", "TD3", "DQN")
ONNX = ".onnx"


def require_policy(path: Path) -> None:
    """Raise an error if a file can't be a policy, judged by its first bytes, before any other work.

    Raises:
        UnusablePolicy: it is neither a ZIP file nor called ``.onnx``.
        FileNotFoundError: there is no such file.
    """
    if not path.is_file():
        raise missing_policy(path)
    if path.suffix.lower() != ONNX and not zipfile.is_zipfile(path):
        raise UnusablePolicy(
            f"{path} is not a policy: expected a ZIP file of surrogym train or Stable-Baselines3, or a file ending in "
            f"{ONNX}"
        )


def card_of_policy(path: Path) -> PolicyCard:
    """Read the card of a file, after a check that the file may be a policy.

    Raises:
        UnusablePolicy: the file can't be a policy, or its card is invalid.
        FileNotFoundError: there is no such file.
    """
    require_policy(path)
    return read_card(path)


def load_policy(path: Path, algorithm: str = DEFAULT_ALGORITHM, *, trust: bool = False) -> Predict:
    """Load a policy as a function from observations to the most probable actions. Nothing is unpickled without
    ``trust``.

    Args:
        path: file from ``surrogym train``, ``Network.save`` or ``surrogym export-policy``; or, with ``trust``, from
            ``save`` of a Stable-Baselines3 algorithm.
        algorithm: name of the Stable-Baselines3 class; a network of arrays and ONNX need none.
        trust: whether to unpickle the policy's objects, which runs any code that is in them.

    Raises:
        UnusablePolicy: the algorithm is unknown, the file is not one of its policies, it needs ``trust``, or it learned
            in a ``VecNormalize`` whose statistics are not beside it.
        UnusableOnnx: the file is not a policy in ONNX, or it could need more memory than a policy should.
    """
    if Network.is_at(path):
        return load_network(path)
    if path.suffix.lower() == ONNX:
        return load_onnx(path)
    if PlannerFile.is_at(path):
        return PlannerFile.load(path).acting()
    model = read_learner(path, algorithm, trust, {})
    normalise = _normalisation(path, model)

    def predict(observations: NDArray[np.float32]) -> NDArray[Any]:
        shown = observations if normalise is None else normalise(observations)
        actions: NDArray[Any] = model.predict(shown, deterministic=True)[0]
        return actions

    return predict


def save_policy(learner: BaseAlgorithm, path: Path) -> None:
    """Save a policy as ``learner.save`` does, with a description from which ``load_learner`` reads it without
    unpickling."""
    from surrogym_trainer.policies.structure import save

    save(learner, path)


def load_learner(
    path: Path, algorithm: str = DEFAULT_ALGORITHM, /, *, trust: bool = False, **changes: Any
) -> BaseAlgorithm:
    """Load an algorithm of Stable-Baselines3 from its file. Nothing is unpickled without ``trust``.

    Args:
        path: file from ``save_policy``; or, with ``trust``, from ``save`` of the algorithm.
        algorithm: name of the algorithm's class.
        trust: whether to unpickle the objects in the file, which runs any code that is in them.
        changes: environment, seed and hyperparameters that replace the saved ones; the algorithm can only learn with an
            environment.

    Raises:
        UnusablePolicy: the algorithm is unknown, the file is not one of its policies, it needs ``trust``, or it learned
            in a ``VecNormalize``.
    """
    model = read_learner(path, algorithm, trust, changes)
    if is_normalised(model):
        raise UnusablePolicy(
            f"expected a policy that sees observations as they are, got {path}, which learned in a VecNormalize: "
            "surrogym evaluate can run it, with the statistics beside it"
        )
    return model


def _normalisation(path: Path, model: BaseAlgorithm) -> Normalisation | None:
    """Return the normalisation of a policy's observations; None if they are not normalised."""
    if not is_normalised(model):
        return None
    if not statistics_path(path).is_file():
        raise missing_statistics(path)
    return Normalisation(statistics_path(path))


def read_learner(path: Path, algorithm: str, trust: bool, changes: dict[str, Any]) -> BaseAlgorithm:
    """Load an algorithm of Stable-Baselines3 from its file. Arguments and errors are those of ``load_learner``."""
    import stable_baselines3

    if PlannerFile.is_at(path):
        raise UnusablePolicy(
            f"{path} is a planner, which has no network: surrogym evaluate and surrogym audit can run it"
        )
    kind = getattr(stable_baselines3, algorithm.upper(), None)
    if kind is None or not hasattr(kind, "load"):
        raise UnusablePolicy(f"Stable-Baselines3 has no algorithm {algorithm!r}: expected for instance PPO, SAC or DQN")
    try:
        return _loaded(kind, path, trust, changes if "env" in changes else BUFFERLESS | changes)
    except UnusablePolicy:
        raise
    except pickle.UnpicklingError as error:
        raise UnusablePolicy(
            f"{path}: expected weights that are numbers, got other pickled objects: save the policy again"
        ) from error
    except Exception as error:  # a malformed file can raise anything
        if changes:
            read_learner(path, algorithm, trust, {})
            given = [f"{name}={value!r}" for name, value in changes.items() if name not in ("env", "seed")]
            raise UnusablePolicy(f"{path} does not fit {', '.join([*given, 'this surrogate'])}: {error}") from error
        fitting = [other for other in FAMILIES if other != algorithm.upper() and _fits(other, path, trust)]
        meant = (
            f"expected --algorithm {' or '.join(fitting)}"
            if fitting
            else f"{error}; give its --algorithm, or another file"
        )
        raise UnusablePolicy(f"{path} is not a policy of {algorithm}: {meant}") from error


def _fits(algorithm: str, path: Path, trust: bool) -> bool:
    """Return whether a file is a policy of an algorithm of Stable-Baselines3."""
    import stable_baselines3

    try:
        _loaded(getattr(stable_baselines3, algorithm), path, trust, BUFFERLESS)
    except Exception:  # a malformed file can raise anything
        return False
    return True


def _loaded(kind: type[BaseAlgorithm], path: Path, trust: bool, changes: dict[str, Any]) -> BaseAlgorithm:
    from surrogym_trainer.policies.structure import PickledObjects, read

    if trust:
        return kind.load(path, device="cpu", **changes)
    try:
        file, objects = read(path, num_envs=_num_envs(changes.get("env")), replaced=set(changes))
    except PickledObjects as error:
        raise UnusablePolicy(
            f"{path} holds pickled objects ({', '.join(error.names)}), and reading them would run any code that is in "
            "them: give --trust-policy (trust=True in Python) if you trust who made the file"
        ) from None
    return kind.load(file, device="cpu", custom_objects=objects, **changes)


def _num_envs(env: object) -> int:
    """Return the number of environments that step at once; 0 without an environment."""
    return 0 if env is None else getattr(env, "num_envs", 1)


def load_network(path: Path) -> Network:
    """Load a network of arrays.

    Raises:
        UnusablePolicy: the file is not a network of arrays.
    """
    try:
        return Network.load(path)
    except ValueError as error:
        raise UnusablePolicy(str(error)) from error
