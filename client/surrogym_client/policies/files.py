"""A policy on disk: what Stable-Baselines3 wrote, and beside it a card that says what it is for."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, RootModel, ValidationError

from surrogym_client.errors import SurrogymClientError
from surrogym_client.evaluation.evaluator import Predict
from surrogym_client.policies.onnx_files import load_onnx
from surrogym_shared.network import Network
from surrogym_shared.spec import EnvironmentSpec
from surrogym_shared.wire import SurrogateName

if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm

DEFAULT_ALGORITHM = "PPO"
BUFFERLESS = {"n_envs": 1, "n_steps": 1, "buffer_size": 1}  # what only acts needs no room for experience
ONNX = ".onnx"
MAX_CARD_BYTES = 1024 * 1024


class UnusablePolicy(SurrogymClientError):
    """The file is no policy of the algorithm, or its card is none."""


class NotedAddress(RootModel[str]):
    """A server's address that a file names. It is no ``str``, so that nothing connects to it: only a person gives the
    address to which a token goes."""

    model_config = ConfigDict(frozen=True)

    def __str__(self) -> str:
        return self.root


class PolicyCard(BaseModel):
    """What a policy is for and how it came about; a JSON file of the same name beside it."""

    model_config = ConfigDict(extra="ignore", frozen=True)  # train() notes more than is read here

    algorithm: str = DEFAULT_ALGORITHM
    surrogate: SurrogateName | None = None
    server: NotedAddress | None = None
    spec: EnvironmentSpec | None = None
    seed: int | None = None
    virtual_steps: int | None = None
    seconds: float | None = None
    imagined_return: float | None = None
    visited_confidence: tuple[float | None, ...] = ()
    networks: int = 1  # that learned in the last training
    settings: dict[str, Any] = Field(default_factory=dict)
    versions: dict[str, str] = Field(default_factory=dict)


def card_path(policy: Path) -> Path:
    """Where the card of a policy lies."""
    return policy.with_suffix(".json")


def write_card(policy: Path, card: PolicyCard) -> None:
    """Write the card beside the policy."""
    card_path(policy).write_text(card.model_dump_json(indent=2) + "\n", encoding="utf-8")


def read_card(policy: Path) -> PolicyCard:
    """The card of a policy; an empty one where there is none.

    Raises:
        UnusablePolicy: the card is invalid, or has more than ``MAX_CARD_BYTES``.
        FileNotFoundError: there is no such policy.
    """
    if not policy.is_file():
        raise FileNotFoundError(2, "no such policy file", str(policy))
    if not card_path(policy).exists():
        return PolicyCard()
    with card_path(policy).open("rb") as file:
        content = file.read(MAX_CARD_BYTES + 1)
    if len(content) > MAX_CARD_BYTES:
        raise UnusablePolicy(f"{card_path(policy)} is no card of a policy: expected at most {MAX_CARD_BYTES} bytes")
    try:
        return PolicyCard.model_validate_json(content)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        raise UnusablePolicy(f"{card_path(policy)} is no card of a policy: {where}: {first['msg']}") from error


def load_policy(path: Path, algorithm: str = DEFAULT_ALGORITHM, *, trust: bool = False) -> Predict:
    """The policy as a function of observations, its most probable action each. Nothing is unpickled without ``trust``.

    Args:
        path: what ``surrogym train``, ``Network.save`` or ``surrogym export-policy`` wrote, or, with ``trust``,
            ``save`` of a Stable-Baselines3 algorithm.
        algorithm: name of its class; a network of arrays and ONNX need none.
        trust: unpickle a policy's objects, which runs any code that is in them.

    Raises:
        UnusablePolicy: no such algorithm, the file is none of its policies, or it needs ``trust``.
        UnusableOnnx: the file is no policy in ONNX, or it could ask for more memory than a policy needs.
    """
    if Network.is_at(path):
        return _network(path)
    if path.suffix.lower() == ONNX:
        return load_onnx(path)
    model = load_learner(path, algorithm, trust=trust)

    def predict(observations: NDArray[np.float32]) -> NDArray[Any]:
        actions: NDArray[Any] = model.predict(observations, deterministic=True)[0]
        return actions

    return predict


def save_policy(learner: BaseAlgorithm, path: Path) -> None:
    """Write what ``learner.save`` writes, with a description by which ``load_learner`` reads it without unpickling."""
    from surrogym_client.policies.structure import save

    save(learner, path)


def load_learner(
    path: Path, algorithm: str = DEFAULT_ALGORITHM, /, *, trust: bool = False, **changes: Any
) -> BaseAlgorithm:
    """An algorithm of Stable-Baselines3 from its file. Nothing is unpickled without ``trust``.

    Args:
        path: what ``save_policy`` wrote, or, with ``trust``, ``save`` of the algorithm.
        algorithm: name of its class.
        trust: unpickle its objects, which runs any code that is in them.
        changes: environment, seed and hyperparameters, in the place of those that it was saved with; with an
            environment the algorithm can learn on.

    Raises:
        UnusablePolicy: no such algorithm, the file is none of its policies, or it needs ``trust``.
    """
    import stable_baselines3

    kind = getattr(stable_baselines3, algorithm.upper(), None)
    if kind is None or not hasattr(kind, "load"):
        raise UnusablePolicy(f"Stable-Baselines3 has no algorithm {algorithm!r}: expected for instance PPO, SAC or DQN")
    try:
        return _loaded(kind, path, trust, changes if "env" in changes else BUFFERLESS | changes)
    except UnusablePolicy:
        raise
    except pickle.UnpicklingError as error:
        raise UnusablePolicy(f"{path}: expected numbers alone as weights, got other pickled objects") from error
    except Exception as error:  # somebody's file can raise anything
        if changes:
            load_learner(path, algorithm, trust=trust)
            given = [f"{name}={value!r}" for name, value in changes.items() if name not in ("env", "seed")]
            raise UnusablePolicy(f"{path} does not go with {', '.join([*given, 'this surrogate'])}: {error}") from error
        raise UnusablePolicy(f"{path} is no policy of {algorithm}: {error}") from error


def _loaded(kind: type[BaseAlgorithm], path: Path, trust: bool, changes: dict[str, Any]) -> BaseAlgorithm:
    from surrogym_client.policies.structure import PickledObjects, read

    if trust:
        return kind.load(path, device="cpu", **changes)
    try:
        file, objects = read(path, lanes=_lanes(changes.get("env")), replaced=set(changes))
    except PickledObjects as error:
        raise UnusablePolicy(
            f"{path} holds pickled objects ({', '.join(error.names)}), and reading them would run any code that is in "
            "them: give --trust-policy (trust=True in Python) if you trust who made the file"
        ) from None
    return kind.load(file, device="cpu", custom_objects=objects, **changes)


def _lanes(env: object) -> int:
    """How many environments step at once; 0 without an environment."""
    return 0 if env is None else getattr(env, "num_envs", 1)


def _network(path: Path) -> Predict:
    try:
        return Network.load(path)
    except ValueError as error:
        raise UnusablePolicy(str(error)) from error
