"""The effect on a policy's imagined return of the model errors that real steps have shown.

Shapes: n steps, O outputs, P inputs, K rows of weights, each for one possible error of the model.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surrogym_shared.port import SurrogatePort
from surrogym_shared.spec import EnvironmentSpec
from surrogym_shared.wire import OF_PARTICLES
from surrogym_trainer.evaluation.audit import SHIFT_ALARM, Compared
from surrogym_trainer.evaluation.imagined import imagine
from surrogym_trainer.evaluation.systematic import Inputs, Region, Systematic, region
from surrogym_trainer.policies.predict import Predict

# If all real steps that test a policy's model share an error, the error's effect on the return is computed for this
# number of possible errors, which are drawn from the posterior distribution.
DRAWS = 64
STARTS = 4  # to see the effect of one error of the model, the return is the mean over this number of virtual episodes
# an output is reported only if the probability that its errors have a part that all steps share exceeds this
CERTAIN = 0.9
# for the reported effect of one output's errors, the return is the mean over this number of virtual episodes
EFFECT_STARTS = 32

Array = NDArray[np.float64]


def changes_of(
    port: SurrogatePort,
    predict: Predict,
    seed: int,
    session: Mapping[str, Any],
    version: int,
    shifted: Systematic,
    weights: Array,
    starts: int = STARTS,
) -> Array:
    """Return the changes (K,) of the policy's mean return in the model if each of K errors is added to the model's
    outputs.

    The episodes with and without the errors have the same starts and the same noise, and follow the model's mean.

    Args:
        port: the surrogate.
        predict: the policy.
        seed: seed of the starts and the noise.
        session: fields of ``OpenSession`` that the policy was trained with.
        version: version of the model that was compared with the real steps.
        shifted: the test for errors that all steps share, which names the outputs and standardises the inputs.
        weights: the K errors (K, O, 1 + P): for each output, a constant and a factor for each of P standardised inputs.
        starts: number of virtual episodes for each of the K errors.
    """
    if not weights.any():
        return np.zeros(len(weights))
    spec = port.spec()
    outputs = [coordinate.name for coordinate in spec.coordinates if coordinate.moves] + ["reward"]
    placed = np.zeros((len(weights), len(outputs), weights.shape[2]))
    placed[:, [outputs.index(name) for name in shifted.names]] = weights
    left_out = {"variant", "functions", "penalty", *OF_PARTICLES}
    options = {name: value for name, value in session.items() if name not in left_out}
    options |= {"variant": "deterministic", "penalty": 0.0, "model": version}
    lanes = len(weights) * starts
    usual = imagine(port, predict, lanes, seed, **options).returns
    changed = imagine(port, predict, lanes, seed, **options, residual=shifted.inputs.residual(placed)).returns
    changes: Array = (changed - usual).reshape(starts, len(weights)).mean(0)
    return np.where(weights.any((1, 2)), changes, 0.0)


@dataclass(frozen=True)
class Effect:
    """An error of an output that all steps share, and its effect.

    Attributes:
        output: the output's name.
        error: mean of real minus predicted values, in the output's unit.
        region: range of an input in which the error is largest; None if it is much the same everywhere.
        change: change of the imagined return by the error; None if it was not computed.
    """

    output: str
    error: float
    region: Region | None
    change: float | None

    def words(self) -> str:
        """Return a sentence about the output's error, where it is largest, and how much it changes the return."""
        where = ""
        if (at := self.region) is not None:
            where = f", {at.error:+.3g} where {at.name} is between {at.low:.4g} and {at.high:.4g}"
        cost = "" if self.change is None else f"; in the model this changes the return by {self.change:+.4g}"
        return f"{self.output} is {self.error:+.3g} off the prediction on average{where}{cost}"


def effects_of(
    spec: EnvironmentSpec, compared: Compared, change: Callable[[Systematic, Array], Array] | None
) -> tuple[list[Effect], Array]:
    """Find the outputs whose errors have a part that all steps share. The output whose error has the largest effect on
    the return comes first.

    Args:
        spec: specification of the environment.
        compared: the real steps with their predictions.
        change: computes the changes (K,) of the return that K errors cause, each given by weights (O, 1 + P); None
            leaves the changes out.

    Returns:
        The effects, and the contribution (n,) of each step to them: the sum of its errors in the direction of the
        shared errors, each divided by the model's error on left-out samples and weighted by the size of the effect.
    """
    shifted = compared.together(spec, Inputs.over(spec, compared.states, compared.actions))
    weights, outputs = shifted.expected(), np.flatnonzero(shifted.chances > CERTAIN).tolist()
    if shifted.evidence < 1 / SHIFT_ALARM or not len(outputs):
        return [], np.zeros(len(compared.errors))
    alone = np.zeros((len(outputs), *weights.shape))
    for row, output in enumerate(outputs):
        alone[row, output] = weights[output]
    changes = [None] * len(outputs) if change is None else change(shifted, alone).tolist()
    names = [*spec.coordinate_names, *(f"action {i}" for i in range(spec.action.size))]
    at = np.concatenate([compared.states, compared.actions], 1)
    found = [
        Effect(compared.names[o], float(errors.mean()), region(names, at, errors), moved)
        for o, errors, moved in zip(outputs, compared.errors.T[outputs], changes, strict=True)
    ]
    explained = shifted.inputs.at(spec, compared.states, compared.actions) @ weights[outputs].T
    importance = np.array([1.0 if moved is None else abs(moved) for moved in changes])
    importance = importance / max(float(importance.max()), 1e-300)
    along = np.sign(explained) * compared.errors[:, outputs] / compared.claimed_alone[outputs]
    share = (np.maximum(along, 0.0) * importance).sum(1)
    return sorted(found, key=lambda one: -abs(one.change or 0.0)), share
