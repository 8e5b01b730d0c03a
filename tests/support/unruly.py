"""A family of models that breaks one law of the port, which its setting names: Gaussian processes, and something bent.

What it breaks when it learns is named as it is; ``served.*`` is broken by the model that is loaded from storage.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from concurrent.futures import CancelledError
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.environment.samples import Samples
from surrogym_server.models.gaussian_process import GaussianProcesses
from surrogym_server.models.port import DynamicsModel, Learned, Learner, ModelCodec, StoredModel, Transition, Warm

BLOCKED_SECONDS = 3600
SERVED = "served."
ORDERLY = "orderly"


class TwoArguments(Exception):
    def __init__(self, output: str, why: str) -> None:
        super().__init__(f"{output}: {why}")


def raised(error: BaseException) -> Callable[[Any], Any]:
    def bend(_: Any) -> Any:
        raise error

    return bend


TRANSITIONS: dict[str, Callable[[Any], Any]] = {
    "nan": lambda made: replace(made, q_next=made.q_next * torch.nan),
    "reward": lambda made: replace(made, reward=made.reward * torch.nan),
    "negative": lambda made: replace(made, std=None if made.std is None else -1 - made.std),
    "shape": lambda made: replace(made, reward=made.reward[:, None]),
    "narrow": lambda made: replace(made, q_next=made.q_next[:, :1]),
    "nothing": lambda _: None,
    "raise": raised(RuntimeError("line 1\n   line 2")),
    "exit": raised(SystemExit(3)),
    "interrupt": raised(KeyboardInterrupt()),
}


@dataclass(frozen=True)
class Bent(DynamicsModel):
    """A model of Gaussian processes whose steps are bent."""

    inner: DynamicsModel
    mode: str

    def __getattr__(self, name: str) -> Any:
        return getattr(object.__getattribute__(self, "inner"), name)

    def transition(self, q: Tensor, u: Tensor, **options: Any) -> Transition:
        bent: Transition = TRANSITIONS.get(self.mode, lambda made: made)(self.inner.transition(q, u, **options))
        return bent

    def means(self, q: Tensor, u: Tensor) -> Tensor:
        return self.inner.means(q, u)

    def learned_termination(self, q: Tensor) -> Tensor:
        return self.inner.learned_termination(q)

    @property
    def scales(self) -> Tensor:
        return self.inner.scales

    @property
    def structures(self) -> tuple[str, ...]:
        return self.inner.structures

    @property
    def description(self) -> dict[str, Any]:
        odd: dict[str, Any] = {"tensor": torch.zeros(2), "infinite": float("inf")}
        return self.inner.description | ({"odd": odd[self.mode]} if self.mode in odd else {})


class BentCodec(ModelCodec):
    def encode(self, model: DynamicsModel) -> StoredModel:
        assert isinstance(model, Bent)
        stored = GaussianProcesses("composite", True, "auto").codec.encode(model.inner)
        return StoredModel(stored.header | {"mode": model.mode}, stored.tensors)

    def decode(self, definition: EnvironmentDefinition, stored: StoredModel) -> DynamicsModel:
        header = dict(stored.header)
        mode = str(header.pop("mode"))
        inner = GaussianProcesses("composite", True, "auto").codec.decode(
            definition, StoredModel(header, stored.tensors)
        )
        return Bent(inner, mode.removeprefix(SERVED))


@dataclass(frozen=True)
class Unruly(Learner):
    mode: str = ORDERLY

    @property
    def codec(self) -> ModelCodec:
        return BentCodec()

    def learn(self, definition: EnvironmentDefinition, samples: Samples, warm: Warm | None = None) -> Any:
        match self.mode:
            case "learn.exit":
                sys.exit(3)
            case "learn.cancel":
                raise CancelledError
            case "learn.two":
                raise TwoArguments("x", "boom")
            case "learn.block":
                time.sleep(BLOCKED_SECONDS)
            case "learn.nothing":
                return None
        made = GaussianProcesses("composite", True, "auto").learn(definition, samples)
        return Learned(Bent(made.model, self.mode), {} if self.mode != "warm" else {"theta": "hot"})  # type: ignore[dict-item]
