"""The state of a machine from noisy measurements: an extended Kalman filter on a model's steps."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from surrogym_server.errors import InvalidInput
from surrogym_server.models.abilities import ArraySteps, LearnedNoise, offers
from surrogym_server.models.port import DynamicsModel
from surrogym_server.planning.pending import random_actions

Floats = NDArray[np.float64]

DIFFERENCE = 1e-3  # step of the numerical derivatives, as a share of each coordinate's sampling range
# A measurement this number of standard deviations from the predicted one contradicts the prediction.
CONTRADICTION = 5.0
POINTS = 256  # random states and actions over which derivatives are averaged
LEAST = 1e-6  # least standard deviation of a prediction and of a measurement, as a share of the sampling range


@dataclass(frozen=True, eq=False)
class StateFilter:
    """Extended Kalman filter of N states of C coordinates. It works in units of each coordinate's sampling range.

    The noise of a prediction is the model's uncertainty, and the part of its learned noise that measurement errors do
    not explain.
    """

    steps: ArraySteps
    span: Floats  # (C,) length of each coordinate's sampling range
    cyclic: NDArray[np.bool_]  # (C,)
    measured: Floats  # (C, C) covariance of a measurement's errors
    process: Floats  # (C,) variance of the noise of a step
    moving: NDArray[np.int64] = field(repr=False)  # (M,) indices of the coordinates that the model moves

    @classmethod
    def of(cls, model: DynamicsModel, steps: ArraySteps, noise: Mapping[str, float]) -> StateFilter:
        """Return the filter of a model, for sensors with the standard deviations ``noise``, by coordinate.

        Raises:
            InvalidInput: a name is not that of a coordinate that the model moves, or the model predicts changes of the
                observation.
        """
        definition = model.definition
        if definition.moves_observation:
            raise InvalidInput(
                "sensor_noise: expected a model that predicts changes of coordinates, got one of the observation "
                "(preset 'paper')"
            )
        names, moving = definition.coordinate_names, np.array(definition.moving)
        low, high = (ends.cpu().numpy() for ends in definition.sampled)
        for name in noise:
            if name not in [names[i] for i in moving]:
                raise InvalidInput(f"sensor_noise: expected names of coordinates that change in steps, got {name!r}")
        span = high - low
        measured = np.diag(np.maximum([noise.get(name, 0.0) for name in names] / span, LEAST) ** 2)
        cyclic = np.array([c.kind == "angle" for c in definition.coordinates])
        made = cls(steps, span, cyclic, measured, np.zeros(len(names)), moving)
        able = offers(model, LearnedNoise)
        if able is not None:
            made.process[moving] = (np.array(able.noise_stds[: len(moving)]) / span[moving]) ** 2
            # A step's learned noise is that of the process, and of what was measured before and after it.
            made.process[:] = (made.process - np.diag(measured) - made._carried(low, high)).clip(0)
        return made

    def _carried(self, low: Floats, high: Floats) -> Floats:
        """Return the variance (C,) of the predictions that errors of the measured state before a step cause, averaged
        over the sampling range from ``low`` to ``high`` (C,)."""
        rng = np.random.default_rng(0)
        q = rng.uniform(low, high, (POINTS, len(low)))
        u = random_actions(self.steps.definition.action, rng, POINTS)
        jacobian, _ = self._around(q, u)
        return np.asarray((jacobian**2 @ np.diag(self.measured)).mean(0))

    @property
    def errors(self) -> Floats:
        """Largest errors of measurements that are expected, (C,)."""
        return CONTRADICTION * self.span * np.sqrt(np.diagonal(self.measured))

    def predicted(self, q: Floats, covariance: Floats, u: Floats) -> Floats:
        """Return the covariances (N, C, C) of the states after a step from states q (N, C), which have the covariances
        ``covariance`` (N, C, C), under actions u (N, F)."""
        jacobian, uncertain = self._around(q, u)
        variances = np.maximum(uncertain + self.process, LEAST**2)
        result: Floats = jacobian @ covariance @ jacobian.swapaxes(1, 2) + variances[:, :, None] * np.eye(q.shape[1])
        return result

    def _around(self, q: Floats, u: Floats) -> tuple[Floats, Floats]:
        """Return the derivatives (N, C, C) of the coordinates after a step with respect to those before it, and the
        model's variances (N, C), at states q (N, C) and actions u (N, F)."""
        count, size = q.shape
        change, points = np.diag(DIFFERENCE * self.span), 2 * size + 1
        around = np.concatenate([q[:, None] + change, q[:, None] - change, q[:, None]], 1).reshape(-1, size)
        acting = np.repeat(u, points, axis=0)
        found = self.steps(around, acting, noise=None, process=None, paths=None, stds=True, reward_std=False)
        after = found.q_next.reshape(count, points, size)
        slopes = apart(after[:, :size], after[:, size:-1], self.cyclic) / self.span / (2 * DIFFERENCE)
        uncertain = np.zeros((count, size))
        std = found.std.reshape(count, points, -1)[:, -1, : len(self.moving)]
        uncertain[:, self.moving] = (std / self.span[self.moving]) ** 2
        return slopes.swapaxes(1, 2), uncertain

    def corrected(self, measured: Floats, q: Floats, covariance: Floats) -> tuple[Floats, Floats]:
        """Return the states (N, C) and their covariances (N, C, C) after measurements (N, C) of states that were
        predicted as q (N, C) with the covariances ``covariance`` (N, C, C).

        If a measurement contradicts the prediction, the state begins anew at what was measured.
        """
        error = apart(measured, q, self.cyclic) / self.span
        total = covariance + self.measured
        gain = np.linalg.solve(total, covariance).swapaxes(1, 2)
        state = q + self.span * (gain @ error[:, :, None])[:, :, 0]
        kept = np.eye(len(self.span)) - gain
        after = kept @ covariance @ kept.swapaxes(1, 2) + gain @ self.measured @ gain.swapaxes(1, 2)
        within = np.abs(error) <= CONTRADICTION * np.sqrt(np.diagonal(total, axis1=1, axis2=2))
        anew = np.flatnonzero(~within.all(1))
        state[anew], after[anew] = measured[anew], self.measured
        return state, after


def apart(q: Floats, others: Floats, cyclic: NDArray[np.bool_]) -> Floats:
    """Return q (..., C) minus other states (..., C); differences of coordinates that are ``cyclic`` (C,), angles, lie
    between -pi and pi."""
    difference = q - others
    return np.where(cyclic, (difference + np.pi) % (2 * np.pi) - np.pi, difference)
