"""Step of N lanes (parallel environments), in compiled code if the settings of the session say so, else in torch."""

from __future__ import annotations

import logging
from dataclasses import replace

import torch

from surrogym_server.models.abilities import ArraySteps, CompiledSteps, offers
from surrogym_server.models.draws import function_draws
from surrogym_server.models.port import DynamicsModel
from surrogym_server.virtual import environment
from surrogym_server.virtual.environment import Bools, Floats, LaneTransition, VirtualSettings
from surrogym_server.virtual.lanes import LaneState

logger = logging.getLogger(__name__)


def in_fastest_form(settings: VirtualSettings, model: DynamicsModel) -> VirtualSettings:
    """Return the settings of a new session, with ``compiled`` set to True if the model's compiled steps work on this
    machine and are faster than torch.

    With a residual, ``compiled`` stays False, because compiled steps don't support a residual.
    """
    stds = settings.variant == "probabilistic" or settings.penalty > 0 or settings.doubts
    able = None if settings.residual is not None else offers(model, CompiledSteps)
    if able is None or not able.compiled_pays(stds=stds):
        return settings
    try:
        return replace(settings, compiled=_array_steps(model, replace(settings, compiled=True)) is not None)
    except Exception:  # on an unsupported platform, numba may raise any error; torch then computes the steps
        logger.warning("steps can't be compiled on this machine, so torch computes them", exc_info=True)
        return settings


def step(
    model: DynamicsModel,
    settings: VirtualSettings,
    lanes: LaneState,
    u: Floats,
    mask: Bools | None = None,
    stds: bool = False,
) -> tuple[LaneState, LaneTransition]:
    """Step all N lanes (parallel environments), or those that ``mask`` (N,) selects, under actions u (N, F).

    Args:
        model: the model.
        settings: settings of the session.
        lanes: state of the lanes.
        u: actions, in the form in which the model takes them.
        mask: lanes to step, or None for all.
        stds: whether to return the standard deviation of each output.

    Returns:
        The state after the step, and its results.

    Raises:
        InvalidInput: the mask has a wrong length.
        NotReset: a lane was never reset, or its episode has ended and autoreset does not reset it in this step.
    """
    move = _array_steps(model, settings)
    if move is None or settings.variant == "probabilistic":
        return environment.step(model, settings, lanes, u, mask, stds, particle_steps=move)
    from surrogym_server.virtual.compiled.step import compiled_step

    if model.definition.rates:
        u = model.definition.within_rates(lanes.q, torch.from_numpy(u)).numpy()
    return compiled_step(model, move, settings, lanes, u, mask, stds)


def _array_steps(model: DynamicsModel, settings: VirtualSettings) -> ArraySteps | None:
    if not settings.compiled:
        return None
    if settings.variant != "pathwise":
        able = offers(model, CompiledSteps)
        return None if able is None else able.compiled()
    draws = function_draws(model, settings.functions)
    return draws.compiled() if isinstance(draws, CompiledSteps) else None
