"""Export of a policy for use without Stable-Baselines3: its most probable action, in ONNX or as a ``torch.export``
program.

Input ``observation`` (N, D) float32, output ``action``: (N, F) float32 within the bounds, or the chosen numbers, (N,)
or (N, F) int64. Standardisation and clipping are included, and N is free.
"""

from __future__ import annotations

import io
import logging
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm
from torch import Tensor, nn
from torch.export import Dim, ExportedProgram

from surrogym_client.errors import SurrogymClientError
from surrogym_shared.network import Network
from surrogym_trainer.policies.files import load_learner
from surrogym_trainer.policies.onnx_files import from_onnx
from surrogym_trainer.policies.predict import Predict

CHECKS = 1_000  # number of random observations on which policy and export are compared
TOLERANCE = 1e-5  # largest difference between the actions of policy and export, as a share of their range
Form = Callable[[ExportedProgram], bytes]


class NotExportable(SurrogymClientError):
    """The policy can't be converted to ONNX or torch.export."""


class MostProbable(nn.Module):
    """The most probable action of a Stable-Baselines3 policy as a torch module; it equals the policy's ``predict``."""

    low: Tensor
    high: Tensor

    def __init__(self, learner: BaseAlgorithm) -> None:
        super().__init__()
        self.policy, space = learner.policy, learner.action_space
        self.size = int(np.prod(learner.observation_space.shape or (1,)))
        self._continuous = isinstance(space, spaces.Box)
        if isinstance(space, spaces.Box):
            self.register_buffer("low", torch.as_tensor(space.low))
            self.register_buffer("high", torch.as_tensor(space.high))

    def forward(self, observation: Tensor) -> Tensor:
        action: Tensor = self.policy._predict(observation, deterministic=True)
        if not self._continuous:
            return action
        if self.policy.squash_output:
            return self.low + (self.high - self.low) * (action + 1) / 2
        return torch.clamp(action, self.low, self.high)


class ArrayNetwork(nn.Module):
    """A ``Network`` of arrays as a torch module. It computes in float64, as the network does."""

    mean: Tensor
    deviation: Tensor
    low: Tensor
    high: Tensor

    def __init__(self, network: Network) -> None:
        super().__init__()
        self.size, self._counts, self._layers = len(network.mean), network.counts, len(network.layers)
        self._activation = torch.tanh if network.activation == "tanh" else torch.relu
        bounds = () if network.counts else ("low", "high")
        arrays = {name: getattr(network, name) for name in ("mean", "deviation", *bounds)}
        for i, layer in enumerate(network.layers):
            arrays |= {f"weights{i}": layer.weights, f"bias{i}": layer.bias}
        for name, array in arrays.items():
            self.register_buffer(name, torch.as_tensor(array, dtype=torch.float64))

    def forward(self, observation: Tensor) -> Tensor:
        y = (observation.double() - self.mean) / self.deviation
        for i in range(self._layers):
            y = (self._activation(y) if i else y) @ getattr(self, f"weights{i}") + getattr(self, f"bias{i}")
        if not self._counts:
            action: Tensor = (self.low + self.high) / 2 + (self.high - self.low) / 2 * torch.tanh(y)
            return action.float()
        chosen = [group.argmax(-1) for group in torch.split(y, list(self._counts), dim=-1)]
        return chosen[0] if len(chosen) == 1 else torch.stack(chosen, -1)


def export_policy(policy: Path, out: Path, algorithm: str, *, trust: bool = False) -> float:
    """Convert a policy to the format of the ending of ``out``, ``.onnx`` or ``.pt2``, and check the file.

    The file is read back, and kept only if its actions on random observations are those of the policy. Returns the
    largest difference, which is 0 for discrete actions.

    Args:
        policy: policy file from ``surrogym train`` or Stable-Baselines3.
        out: file to write.
        algorithm: name of the Stable-Baselines3 class; a network of arrays needs none.
        trust: whether to unpickle the policy's objects, which runs any code that is in them.

    Raises:
        NotExportable: ``out`` has another ending, or the actions differ.
        UnusablePolicy: the file is not a policy of the algorithm, or it needs ``trust``.
        ModuleNotFoundError: ONNX needs the extra ``export``.
    """
    forms: dict[str, tuple[Form, Callable[[bytes], Predict]]] = {
        ".onnx": (to_onnx, from_onnx),
        ".pt2": (_to_program, _from_program),
    }
    if out.suffix.lower() not in forms:
        raise NotExportable(f"expected a file ending in {' or '.join(forms)}, got {out.suffix or 'no ending'!r}")
    write, read = forms[out.suffix.lower()]
    module, predict = _loaded(policy, algorithm, trust=trust)
    with _quietly():
        example = (torch.zeros(2, module.size),)
        program = torch.export.export(module.eval(), example, dynamic_shapes={"observation": {0: Dim("lanes")}})
        content = write(program)
        largest = _difference(predict, read(content), module.size)
    out.write_bytes(content)
    return largest


def to_onnx(program: ExportedProgram) -> bytes:
    """Convert a ``torch.export`` program to ONNX.

    Raises:
        ModuleNotFoundError: the extra ``export`` is not installed.
    """
    import onnx  # noqa: F401  said to be missing before torch says that its own converter is
    import onnxscript  # noqa: F401

    converted = torch.onnx.export(program, input_names=["observation"], output_names=["action"], verbose=False)
    assert converted is not None
    content: bytes = converted.model_proto.SerializeToString()
    return content


def _to_program(program: ExportedProgram) -> bytes:
    file = io.BytesIO()
    torch.export.save(program, file)
    return file.getvalue()


def _from_program(content: bytes) -> Predict:
    module = torch.export.load(io.BytesIO(content)).module()

    def predict(observations: NDArray[np.float32]) -> NDArray[Any]:
        with torch.no_grad():
            action: NDArray[Any] = module(torch.as_tensor(observations)).numpy()
        return action

    return predict


def _loaded(policy: Path, algorithm: str, *, trust: bool) -> tuple[MostProbable | ArrayNetwork, Predict]:
    """Load a policy as a torch module, and as the function that it is compared with."""
    if Network.is_at(policy):
        network = Network.load(policy)
        return ArrayNetwork(network), network
    learner = load_learner(policy, algorithm, trust=trust)
    return MostProbable(learner), lambda observation: learner.predict(observation, deterministic=True)[0]


def _difference(ours: Predict, theirs: Predict, size: int) -> float:
    """Return the largest difference between the actions of two policies for the same random observations (CHECKS, D).

    Raises:
        NotExportable: the difference exceeds the tolerance.
    """
    observations = (3 * np.random.default_rng(0).standard_normal((CHECKS, size))).astype(np.float32)
    expected, got = ours(observations), theirs(observations)
    if expected.shape != got.shape:
        raise NotExportable(
            f"expected the exported file to give actions of shape {expected.shape}, got {got.shape}: use the policy's "
            "zip file instead"
        )
    largest = float(np.abs(expected.astype(np.float64) - got).max())
    bound = TOLERANCE * max(float(np.ptp(expected)), 1.0) if expected.dtype.kind == "f" else 0.0
    if not largest <= bound:
        raise NotExportable(
            f"expected the exported file to give the policy's actions, got actions that differ by up to {largest:g}: "
            "use the policy's zip file instead"
        )
    return largest


@contextmanager
def _quietly() -> Iterator[None]:
    """Silence warnings of the exporters, and turn off torch's checks of distributions, which fail in an export because
    no numbers are known."""
    checked = torch.distributions.Distribution._validate_args
    logging.disable(logging.WARNING)
    torch.distributions.Distribution.set_default_validate_args(False)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        torch.distributions.Distribution.set_default_validate_args(checked)
        logging.disable(logging.NOTSET)
