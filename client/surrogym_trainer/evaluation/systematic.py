"""A joint test of the errors of real steps: do they have a part that all steps share? All functions are pure.

A model can be right in each single step, within its tolerance, and wrong in all of them by the same amount. A return
sums such errors up. So the signed errors e (n,) of an output are compared under two hypotheses:

- ``right``: e ~ N(0, s^2 V), V = I + D (I + F F') / 2 D / c^2, where c is the model's error on left-out samples, D has
  the predicted deviations of its function on the diagonal, and F (n, 1 + P) the standardised inputs with a constant,
  divided by sqrt(1 + P);
- ``shifted``: e ~ N(0, s^2 (V + t^2 A)), where A is 1 1' (the same error everywhere) or F F' (an error that depends on
  where the step is), and t has one of the sizes ``SIZES``, all equally likely.

The scale s is that of the errors in states that the policy visits, where they may be much smaller than over the whole
range. It is unknown, with the conjugate prior of ``DEGREES`` degrees of freedom at c, and integrated out.

The evidence is the mean over outputs, forms and sizes of the likelihood ratio. For a right model its expectation is 1,
also if steps are added one after the other. So it exceeds 1 / a at any time with probability a at most (Ville's
inequality: Ville 1939; Robbins 1970, "Statistical methods related to the law of the iterated logarithm"; with an
unknown scale: Perez-Ortiz, Lardy, de Heide and Grunwald 2022, "E-statistics, group invariance and anytime-valid
testing").

Shapes: n steps, O outputs, C coordinates, F action entries, P inputs, K draws.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from math import sqrt
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from surrogym_shared.spec import EnvironmentSpec
from surrogym_shared.wire import Residual

# if all steps share an error, the test assumes one of these sizes, as a multiple of the errors' remaining standard
# deviation
SIZES = tuple(2.0**i for i in range(-1, 6))
DEGREES = 0.1  # degrees of freedom of the prior for the errors' standard deviation; so few leave it almost unknown
# a standardised input is clipped to this number of standard deviations; sessions that add an error to the model clip it
# likewise
FARTHEST = 3.0
# The test for errors that all steps share takes a model's error on left-out samples to be at least this share of the
# output's tolerance.
LEAST = 1e-3
# to find where an error is largest, an input's range is divided into this number of parts with equal numbers of steps
PARTS = 3

Array = NDArray[np.float64]


def columns(spec: EnvironmentSpec, q: Array, u: Array) -> Array:
    """Return states q (m, C) and actions u (m, F) as columns (m, P); an angle becomes its cosine and sine."""
    found: list[Array] = []
    for index, coordinate in enumerate(spec.coordinates):
        column = q[:, index : index + 1]
        found += [np.cos(column), np.sin(column)] if coordinate.kind == "angle" else [column]
    joined: Array = np.concatenate([*found, u], 1)
    return joined


class Inputs(NamedTuple):
    """The standardisation of inputs, by their mean and standard deviation over the states that a policy visits."""

    centre: Array  # (P,) mean of each of P inputs: coordinates, with cosine and sine for an angle, and action entries
    scale: Array  # (P,) standard deviation of each of the P inputs

    @classmethod
    def over(cls, spec: EnvironmentSpec, q: Array, u: Array) -> Self:
        """Return the standardisation by mean and standard deviation of states q (m, C) and actions u (m, F)."""
        at = columns(spec, q, u)
        spread = at.std(0)
        return cls(at.mean(0), np.where(spread > 1e-9 * (1 + np.abs(at).max(0)), spread, 1.0))

    def at(self, spec: EnvironmentSpec, q: Array, u: Array) -> Array:
        """Return standardised inputs with a constant, (n, 1 + P), for states q (n, C) and actions u (n, F)."""
        x = ((columns(spec, q, u) - self.centre) / self.scale).clip(-FARTHEST, FARTHEST)
        joined: Array = np.concatenate([np.ones((len(x), 1)), x], 1)
        return joined

    def residual(self, weights: Array) -> Residual:
        """Return the session option that adds K errors to the model's O outputs. Each is linear in the inputs, with
        weights (K, O, 1 + P) of a constant and of P inputs."""
        return Residual(centre=self.centre.tolist(), scale=self.scale.tolist(), weights=weights.tolist())


class _Form(NamedTuple):
    """One form that the shared error of an output may have, a constant plus a linear function of P inputs: the prior
    variances (1 + P,) of its weights, and how well it explains the errors."""

    variances: Array
    # likelihood of the errors if all steps share an error of this form, divided by that if the model is right
    evidence: float
    mean: Array  # (1 + P,) posterior mean of the weights of a constant and of P inputs
    root: Array  # (1 + P, 1 + P) square root R of the posterior covariance R R' of the weights

    @classmethod
    def of(cls, errors: Array, x: Array, variances: Array) -> Self:
        """Return the form whose weights have the prior ``variances`` (1 + P,), fitted to errors (n,) at the inputs x
        (n, 1 + P), a constant and P inputs.

        Errors and inputs are whitened: without a shared part, the covariance of the errors is the identity, times an
        unknown factor. With a shared part, it is I + x diag(variances) x', whose inverse and determinant follow from
        matrices of the size of the weights (Woodbury).
        """
        scales, n = np.sqrt(variances), len(errors)
        precision = np.eye(len(scales)) + scales[:, None] * (x.T @ x) * scales
        # posterior covariance of the weights, before it is scaled by the variance of the errors
        covariance = scales[:, None] * np.linalg.solve(precision, np.diag(scales))
        score = x.T @ errors
        right = DEGREES + float(errors @ errors)
        wrong = max(right - float(score @ covariance @ score), DEGREES)
        log_ratio = 0.5 * ((DEGREES + n) * np.log(right / wrong) - np.linalg.slogdet(precision)[1])
        values, vectors = np.linalg.eigh(covariance)
        root = sqrt(wrong / (DEGREES + n)) * vectors * np.sqrt(np.maximum(values, 0.0))
        return cls(variances, float(np.exp(min(log_ratio, 600.0))), covariance @ score, root)


@dataclass(frozen=True)
class Systematic:
    """The result of the test for a part of the model's errors that all real steps share.

    Attributes:
        names: names of the outputs, (O,).
        inputs: the standardisation of the inputs.
        forms: for each output, the forms that its error may have.
    """

    names: tuple[str, ...]
    inputs: Inputs
    forms: tuple[tuple[_Form, ...], ...]

    @property
    def evidence(self) -> float:
        """The evidence that the errors have a shared part, against the hypothesis that the model is right. If the model
        is right, the probability that the evidence ever exceeds a is at most 1 / a."""
        return float(np.mean(self._by_output))

    @cached_property
    def _by_output(self) -> Array:
        return np.array([np.mean([form.evidence for form in forms]) for forms in self.forms])

    @cached_property
    def chances(self) -> Array:
        """The probability (O,) that the errors of each output have a shared part (it is shifted). A priori, half of all
        models are right, and each of the others has one shifted output."""
        odds: Array = self._by_output / len(self.names)
        return odds / (1 + odds)

    def draws(self, count: int, rng: np.random.Generator, wrong: NDArray[np.bool_] | None = None) -> Array:
        """Draw ``count`` samples of the shared error of each output from its posterior distribution.

        A shared error is one that all steps have: a constant plus a linear function of P standardised inputs. Returns
        the weights (count, O, 1 + P) of this function: first the constant, then the factor of each input. They are 0 in
        those samples in which an output has no shared error.

        The outputs that ``wrong`` (O,) marks have a shared error in all draws, because the size of their errors has
        shown that the model is wrong there.
        """
        size = len(self.inputs.centre) + 1
        weights = np.zeros((count, len(self.names), size))
        chances = self.chances if wrong is None else np.where(wrong, 1.0, self.chances)
        for o, (forms, chance) in enumerate(zip(self.forms, chances, strict=True)):
            share = np.array([form.evidence for form in forms])
            which = rng.choice(len(forms), size=count, p=share / share.sum())
            drawn = [forms[i].mean + forms[i].root @ rng.standard_normal(size) for i in which]
            weights[:, o] = np.where(rng.random((count, 1)) < chance, drawn, 0.0)
        return weights

    def expected(self) -> Array:
        """Return the posterior mean of the weights (O, 1 + P) of the shared errors; 0 for an output that more likely
        has no shared error."""
        size = len(self.inputs.centre) + 1
        weights = np.zeros((len(self.names), size))
        for o in np.flatnonzero(self.chances > 0.5).tolist():
            share = np.array([form.evidence for form in self.forms[o]])
            weights[o] = (share[:, None] * [form.mean for form in self.forms[o]]).sum(0) / share.sum()
        return weights


def systematic(
    names: Sequence[str], errors: Array, deviations: Array, claimed: Array, inputs: Inputs, x: Array
) -> Systematic:
    """Test whether errors (n, O) have a part that all steps share.

    Args:
        names: names of the outputs, (O,).
        errors: real minus predicted values (n, O).
        deviations: predicted standard deviations of the function (n, O).
        claimed: error (O,) of the model on left-out samples, which includes the noise.
        inputs: the standardisation of the inputs.
        x: standardised inputs of the steps with a constant, (n, 1 + P).
    """
    constant = np.eye(x.shape[1])[0]
    tilted = np.full(x.shape[1], 1 / x.shape[1])
    smooth = (np.eye(len(x)) + x @ x.T / x.shape[1]) / 2
    forms = []
    for e, deviation, own in zip(errors.T, deviations.T, claimed, strict=True):
        right = np.linalg.cholesky(np.eye(len(x)) + smooth * deviation[:, None] * deviation / own**2)
        whitened = np.linalg.solve(right, np.column_stack([e / own, x]))
        found = [
            _Form.of(whitened[:, 0], whitened[:, 1:], size**2 * part) for part in (constant, tilted) for size in SIZES
        ]
        forms.append(tuple(one._replace(mean=own * one.mean, root=own * one.root) for one in found))
    return Systematic(tuple(names), inputs, tuple(forms))


class Region(NamedTuple):
    """The range of one input in which an output's error is largest, with the mean error there."""

    name: str
    low: float
    high: float
    error: float


def region(names: Sequence[str], values: Array, errors: Array) -> Region | None:
    """Return the range of one input in which the mean of errors (n,) differs most from that of the other steps, by more
    than four standard errors; None if there is none.

    Args:
        names: names of the inputs, (P,).
        values: value of each input at the steps, (n, P).
        errors: real minus predicted values (n,).
    """
    best, found = 4.0, None
    for name, column in zip(names, values.T, strict=True):
        ends = np.quantile(column, np.linspace(0, 1, PARTS + 1))
        for low, high in pairwise(ends):
            inside = (column >= low) & (column <= high)
            count, rest = int(inside.sum()), int((~inside).sum())
            if min(count, rest) < PARTS or abs(errors[inside].mean()) <= abs(errors[~inside].mean()):
                continue
            spread = np.hypot(errors[inside].std() / np.sqrt(count), errors[~inside].std() / np.sqrt(rest))
            apart = abs(errors[inside].mean() - errors[~inside].mean()) / max(spread, 1e-300)
            if apart > best:
                best, found = apart, Region(name, float(low), float(high), float(errors[inside].mean()))
    return found
