"""Search for a reward that is a quadratic function of coordinates, cosines, sines and the action.

Distances to setpoints and costs of control are of this kind. The fit is

    r = c + b . z + z' A z

by least squares, where z holds coordinates, cosines and sines of angles, and action entries, each centred and scaled.

Shapes: n steps, C coordinates, F action entries, k entries of z.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from surrogym_sampler.original.describing.probing import EXACT
from surrogym_sampler.original.protocol import Array
from surrogym_shared.logs.rewards import declared_reward
from surrogym_shared.spec import BoxAction, DeclaredReward, EnvironmentSpec, Quantity, RewardTerm, Term
from surrogym_shared.spec.base import MAX_TERM_PARTS
from surrogym_shared.spec.terms import Part
from surrogym_shared.terms import evaluate

MOST = 120  # no quadratic reward is fitted if it has more than this number of coefficients
ENOUGH = 1.5  # a quadratic reward is fitted only to at least this number of steps for each of its coefficients
# A quadratic reward is possible if it gives the rewards of this share of the steps exactly. The other steps may depend
# on a schedule that is not in the state.
MOSTLY = 0.9
TRIMS = 5  # number of successive fits of a quadratic reward, each to the steps that the previous fit explained best
NOTHING = 1e-10  # a term of a fitted reward below this share of the reward's range is rounding, and is left out

Timing = Literal["after", "before"]


@dataclass(frozen=True)
class Paid:
    """Steps with their rewards.

    Attributes:
        q: states before the steps (n, C).
        u: actions (n, F).
        q_next: states after the steps (n, C).
        reward: rewards (n,).
    """

    q: Array
    u: Array
    q_next: Array
    reward: Array

    def at(self, chosen: slice | NDArray[np.bool_]) -> Paid:
        return Paid(self.q[chosen], self.u[chosen], self.q_next[chosen], self.reward[chosen])

    def one(self, number: int) -> Paid:
        return self.at(slice(number, number + 1))

    def before(self) -> Array:
        """Return the states (n, C) before the steps."""
        return self.q

    def after(self) -> Array:
        """Return the states (n, C) after the steps."""
        return self.q_next

    def joined(self, other: Paid) -> Paid:
        pairs = zip(vars(self).values(), vars(other).values(), strict=True)
        return Paid(*(np.concatenate(pair) for pair in pairs))

    def __len__(self) -> int:
        return len(self.reward)


def coefficients(spec: EnvironmentSpec) -> int:
    """Return the number of coefficients of a quadratic reward in this environment."""
    k = len(_quantities(spec))
    return (k + 1) * (k + 2) // 2


def quadratic_reward(spec: EnvironmentSpec, fitted: Paid, checked: Paid) -> DeclaredReward | None:
    """Fit a quadratic reward to some steps. Return it if it gives the rewards of these and of further steps exactly;
    None otherwise.

    Args:
        spec: the environment. The result is None unless its actions are continuous.
        fitted: steps for the fit.
        checked: steps that only check the fit.
    """
    size = float(np.ptp(fitted.reward))
    enough = ENOUGH * coefficients(spec) <= len(fitted) and coefficients(spec) <= MOST
    if not (isinstance(spec.action, BoxAction) and enough and size > 0):
        return None
    whole = fitted.joined(checked)
    for timing in ("after", "before"):
        found = _fitted(spec, fitted, timing, size)
        if found is not None and error_of(spec, found, whole) <= EXACT * size:
            return found
    return None


def may_be_quadratic(spec: EnvironmentSpec, steps: Paid) -> bool:
    """Return whether a quadratic function explains most of the rewards exactly."""
    if not isinstance(spec.action, BoxAction) or not ENOUGH * coefficients(spec) <= MOSTLY * len(steps):
        return False
    size, kept = float(np.ptp(steps.reward)), round(MOSTLY * len(steps))
    if coefficients(spec) > MOST or size == 0:
        return False
    for read in (steps.q_next, steps.q):
        columns = _columns(_scaled(_read(spec, read, steps.u))[0])
        errors = np.zeros(len(steps))
        for _ in range(TRIMS):
            best = np.argsort(errors, kind="stable")[:kept] if errors.any() else np.arange(len(steps))
            weights = np.linalg.lstsq(columns[best], steps.reward[best], rcond=None)[0]
            errors = np.abs(columns @ weights - steps.reward)
        if np.sort(errors)[kept - 1] <= EXACT * size:
            return True
    return False


def error_of(spec: EnvironmentSpec, reward: DeclaredReward, steps: Paid) -> float:
    """Return the largest absolute error of a declared reward over some steps."""
    declared = spec.model_copy(update={"reward": reward})
    ended = np.zeros(len(steps), dtype=bool)
    return float(np.abs(declared_reward(declared, steps.q, steps.u, steps.q_next, ended) - steps.reward).max())


def _fitted(spec: EnvironmentSpec, steps: Paid, timing: Timing, size: float) -> DeclaredReward | None:
    quantities, x = _quantities(spec), _read(spec, steps.q_next if timing == "after" else steps.q, steps.u)
    z, centre, reach = _scaled(x)
    columns = _columns(z)
    weights = np.linalg.lstsq(columns, steps.reward, rcond=None)[0]
    if np.abs(columns @ weights - steps.reward).max() > EXACT * size:
        return None
    if (fewer := _fewest(_columns(x / reach), steps.reward, EXACT * size)) is not None:
        weights, centre = fewer, np.zeros_like(centre)
    c, b, a = _parts(np.where(np.abs(weights) > NOTHING * size, weights, 0.0), z.shape[1])
    form, b = a / np.outer(reach, reach), b / reach
    c, b = float(c - b @ centre + centre @ form @ centre), b - 2 * form @ centre
    b = np.where(np.abs(b) * np.abs(x).max(0) > NOTHING * size, b, 0.0)
    terms = (*_squares(quantities, a, reach), *_rest(quantities, c if abs(c) > NOTHING * size else 0.0, b))
    return DeclaredReward(kind="declared", timing=timing, terms=terms) if 0 < len(terms) <= MAX_TERM_PARTS else None


def _fewest(columns: Array, reward: Array, tolerance: float) -> Array | None:
    """Return weights (k,) of the k columns (n, k) that give the reward (n,) with an error of at most ``tolerance``, as
    many of them 0 as possible; None if all columns together don't.

    Columns are left out one by one, beginning with the one that contributes least. This removes rounding errors and
    terms that cancel, such as squares of a cosine and a sine.
    """
    kept = np.ones(columns.shape[1], dtype=bool)

    def refit() -> Array | None:
        weights = np.zeros(len(kept))
        weights[kept] = np.linalg.lstsq(columns[:, kept], reward, rcond=None)[0]
        return weights if np.abs(columns @ weights - reward).max() <= tolerance else None

    best = refit()
    if best is None:
        return None
    for index in np.argsort(np.abs(best) * np.abs(columns).max(0)):
        kept[index] = False
        fewer = refit() if kept.any() else None
        kept[index] = fewer is None
        best = best if fewer is None else fewer
    return best


def _read(spec: EnvironmentSpec, q: Array, u: Array) -> Array:
    """Return the values (n, k) of the k quantities of a quadratic reward in states (n, C) under actions (n, F)."""
    columns = [
        u @ np.array(one.action) if one.term is None else evaluate(spec, one.term, q) for one in _quantities(spec)
    ]
    return np.stack(columns, axis=1)


def _scaled(x: Array) -> tuple[Array, Array, Array]:
    """Return the k columns of x (n, k), centred and scaled, their centres (k,), and their scales (k,)."""
    centre, reach = x.mean(0), np.where(np.ptp(x, axis=0) > 0, x.std(0), 1.0)
    return (x - centre) / reach, centre, reach


def _columns(z: Array) -> Array:
    """Return the columns of the quadratic fit: 1, the k columns of z (n, k), and the product of each pair of these,
    including their squares."""
    first, second = np.triu_indices(z.shape[1])
    return np.concatenate([np.ones((len(z), 1)), z, z[:, first] * z[:, second]], axis=1)


def _parts(weights: Array, k: int) -> tuple[float, Array, Array]:
    """Split the weights of the quadratic fit, in the order of ``_columns``, into its constant c, its linear weights b
    (k,), and its symmetric matrix A (k, k)."""
    a = np.zeros((k, k))
    a[np.triu_indices(k)] = weights[1 + k :]
    return float(weights[0]), weights[1 : 1 + k], (a + a.T) / 2


def _squares(quantities: Sequence[Quantity], a: Array, reach: Array) -> Iterator[RewardTerm]:
    """Yield the quadratic part x' A x of a reward as weighted squares of sums, one for each eigenvector of ``a``.

    Args:
        quantities: the k entries of x.
        a: the matrix A (k, k), with each row and column multiplied by the ``reach`` of its quantity.
        reach: scale (k,) of each quantity.
    """
    values, vectors = np.linalg.eigh(a)
    for value, vector in zip(values, vectors.T, strict=True):
        if abs(value) > EXACT**2 * np.abs(values).max():
            direction = np.where(np.abs(vector) > EXACT**2, vector, 0.0) / reach
            largest = direction[np.abs(direction).argmax()]
            of = (_sum(quantities, direction / largest),)
            yield RewardTerm(weight=float(value * largest**2), shape="square", of=of)


def _rest(quantities: Sequence[Quantity], c: float, b: Array) -> Iterator[RewardTerm]:
    """Yield the constant c and the linear part b . x of a reward as reward terms; x has the values of the
    quantities."""
    if b.any():
        yield RewardTerm(shape="linear", of=(_sum(quantities, b),))
    if c:
        yield RewardTerm(weight=c, shape="one")


def _sum(quantities: Sequence[Quantity], weights: Array) -> Quantity:
    """Return the weighted sum of quantities; ``weights`` has one entry for each."""
    parts: tuple[Part, ...] = ()
    action = np.zeros(max(len(one.action) for one in quantities))
    for one, weight in zip(quantities, weights, strict=True):
        if weight and one.term is not None:
            parts += (float(weight) * one.term).parts
        elif weight:
            action += weight * np.array(one.action)
    acting = tuple(map(float, action)) if action.any() else ()
    return Quantity(term=Term(parts=parts) if parts else None, action=acting)


def _quantities(spec: EnvironmentSpec) -> list[Quantity]:
    """Return the quantities of a quadratic reward: coordinates, cosines and sines of angles, and action entries."""
    unit = np.eye(spec.action.size)
    terms = (Quantity(term=term) for term in coordinate_terms(spec))
    return [*terms, *(Quantity(action=tuple(map(float, row))) for row in unit)]


def coordinate_terms(spec: EnvironmentSpec) -> list[Term]:
    """Return the coordinates as terms, each angle followed by its cosine and sine."""
    terms: list[Term] = []
    for coordinate in spec.coordinates:
        terms.append(Term.linear(**{coordinate.name: 1.0}))
        if coordinate.kind == "angle":
            terms += [Term.cos(**{coordinate.name: 1.0}), Term.sin(**{coordinate.name: 1.0})]
    return terms
