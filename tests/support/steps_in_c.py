"""Steps of a model in C, compiled with all warnings as errors, beside those of the model itself."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
import tempfile
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from surrogym_server.models.abilities import WrittenInC, offers
from surrogym_server.models.port import DynamicsModel

COMPILER = next((one for one in ("cc", "gcc", "clang") if shutil.which(one)), "")
needs_compiler = pytest.mark.skipif(not COMPILER, reason="no C compiler is installed")
STRICT = ("-std=c99", "-O1", "-Wall", "-Wextra", "-Werror", "-ffp-contract=off", "-fPIC", "-shared")
DOUBLES = ctypes.POINTER(ctypes.c_double)
MEAN, STD = 1e-9, 1e-8  # largest differences; a variance near 0 loses half of its digits
LOOSE = (1e-8, 1e-7)  # for points so close together that torch and numba differ as much; relative 1e-4 of deviations


def library(model: DynamicsModel) -> ctypes.CDLL:
    """The native code of a model's step."""
    able = offers(model, WrittenInC)
    source = None if able is None else able.step_source()
    if source is None or not COMPILER:
        pytest.skip("a step can't be written or compiled in C here")
    with tempfile.TemporaryDirectory() as folder:
        for name, text in source.files.items():
            Path(folder, name).write_text(text, encoding="utf-8")
        made = Path(folder, "step.so")
        subprocess.run([COMPILER, *STRICT, "-o", str(made), "step.c", "-lm"], cwd=folder, check=True)
        return ctypes.CDLL(str(made))


def check_in_c(model: DynamicsModel, points: tuple[Tensor, Tensor], *, loose: bool = False) -> None:
    """From q (m, C) under u (m, F), the step in C has the next state, observation, reward, end and deviations of
    ``transition``."""
    (mean, spread), code, (q, u) = LOOSE if loose else (MEAN, STD), library(model), points
    ours = model.transition(q, u, stds=True, reward_std=True)
    assert ours.std is not None
    assert ours.reward_std is not None
    over, shown = model.terminated(ours.q_next), model.definition.observe(ours.q_next)
    expected = torch.cat([ours.std, ours.reward_std[:, None]], 1)
    q_next, reward = np.empty(q.shape), np.empty(len(q))
    std, observation = np.empty(expected.shape), np.empty(shown.shape)
    terminated = np.empty(len(q), dtype=np.int32)
    for row, (state, action) in enumerate(zip(q.numpy().copy(), u.numpy().copy(), strict=True)):
        ended = ctypes.c_int()
        given = [_pointer(a) for a in (state, action, q_next[row], reward[row:], std[row])]
        code.surrogym_step(*given, ctypes.byref(ended))
        code.surrogym_observe(_pointer(q_next[row]), _pointer(observation[row]))
        terminated[row] = ended.value
    np.testing.assert_array_equal(terminated != 0, over.numpy())
    for got, own in ((q_next, ours.q_next), (reward, ours.reward), (observation, shown)):
        np.testing.assert_allclose(got, own.numpy(), rtol=mean, atol=mean)
    got, own = std / model.scales.numpy(), (expected / model.scales).numpy()
    np.testing.assert_allclose(got, own, rtol=1e-4 if loose else 0, atol=spread)


def _pointer(array: np.ndarray) -> ctypes._Pointer[ctypes.c_double]:
    return array.ctypes.data_as(DOUBLES)
