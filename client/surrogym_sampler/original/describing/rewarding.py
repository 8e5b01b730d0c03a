"""Search for a formula of the reward that a specification can declare, from the steps of a description and some
further ones.

A reward may be a quadratic function of coordinates, cosines, sines and the action. Distances to setpoints and costs
of control are of this kind. The fit is

    r = c + b . z + z' A z

by least squares, where z holds coordinates, cosines and sines of angles, and action entries, each centred and
scaled.

A reward of two values may change at a level of an observation entry, at an ellipsoid or at a box. Bonuses for being
near a goal or above a height are of this kind. Bisections between a step with one value and a step with the other
give points x of the boundary. One end of most bisections is in a random state, so that the points lie on all sides.
A form is found if all points satisfy

    x_i = level,   or   sum_i ((x_i - c_i) / r_i)^2 = 1

where x holds one to three entries, or if most points have one of a few levels, as on the faces of a box, and if the
form gives the reward of every other step. A face is the part of the boundary where one quantity has one value (its
level); the region is on one side of it. A face has at least two points of the boundary. Two points may share a level
by chance, but a few faces that hold most points don't.

Shapes: n steps or states, C coordinates, F action entries, K points of the boundary, k entries of z or of x.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from surrogym_sampler.original.describing.counting import Counted
from surrogym_sampler.original.describing.exploring import Seen
from surrogym_sampler.original.describing.probing import EXACT
from surrogym_sampler.original.gymnasium import wrapped
from surrogym_sampler.original.protocol import Array
from surrogym_shared.logs.rewards import declared_reward
from surrogym_shared.spec import (
    BoxAction,
    DeclaredReward,
    EnvironmentSpec,
    Inequality,
    Quantity,
    RewardTerm,
    Term,
    limits,
)
from surrogym_shared.spec.base import MAX_TERM_PARTS
from surrogym_shared.spec.terms import Part
from surrogym_shared.terms import evaluate, holds

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


LEVEL = 1e-5  # two points count as equal in a quantity (as having one level) up to this share of the quantity's range
SHARED = 2  # boundary points form a face of the box if at least this number of them share the value of a quantity
SURE = 3  # if at least this number of points share the value (level) of a quantity, this is not by chance
MOST_FACES = 6
# smallest share of the boundary points that must lie on faces of the box; the others may be where the state jumps, as
# at a contact
ALMOST_ALL = 0.75


@dataclass(frozen=True)
class _Face:
    term: Term
    level: float
    points: NDArray[np.bool_]  # (K,) mask of those of K boundary points that lie on the face


def has_face(spec: EnvironmentSpec, terms: Sequence[Term], bounds: Array, states: Array) -> bool:
    """Return whether at least three points of the boundary between two values of a reward have the same value (level)
    of some quantity, as the points of a face of a box have.

    Args:
        spec: the environment.
        terms: quantities by which the points are compared.
        bounds: K points of the boundary (K, C).
        states: states (n, C) that show the range of each quantity.
    """
    return any(face.points.sum() >= SURE for face in _faces(spec, terms, bounds, states))


def alone(spec: EnvironmentSpec, terms: Sequence[Term], bounds: Array, states: Array) -> NDArray[np.bool_]:
    """Return a mask (K,) of those of K points of the boundary between two values of a reward that share the value
    (level) of no quantity with another point.

    Args:
        spec: the environment.
        terms: quantities by which the points are compared.
        bounds: K points of the boundary (K, C).
        states: states (n, C) that show the range of each quantity.
    """
    left = np.ones(len(bounds), dtype=bool)
    for face in _faces(spec, terms, bounds, states):
        left &= ~face.points
    return left


def box(
    spec: EnvironmentSpec, terms: Sequence[Term], bounds: Array, states: Array, inside: NDArray[np.bool_]
) -> tuple[Inequality, ...]:
    """Return inequalities that describe the region in which a reward has one of its two values, such as a box; empty if
    there are none. All of them hold inside. At most points of the boundary, a quantity has the limiting value of one of
    them, so the point lies on a face.

    A face of two points is left out if the other faces already exclude all states outside the region.

    Args:
        spec: the environment.
        terms: quantities that the inequalities may limit.
        bounds: K points of the boundary (K, C).
        states: states (n, C) inside and outside the region.
        inside: mask (n,) of those of these states that are in the region.
    """
    left, chosen = np.ones(len(bounds), dtype=bool), list[tuple[int, Inequality]]()
    sided = [
        (face, side) for face in _faces(spec, terms, bounds, states) if (side := _side(spec, face, states[inside]))
    ]
    while sided and len(chosen) < MOST_FACES:
        face, side = max(sided, key=lambda one: int((one[0].points & left).sum()))
        if (shared := int((face.points & left).sum())) < SHARED:
            break
        left &= ~face.points
        chosen.append((shared, Inequality(term=face.term, relation=side, value=face.level)))
    if left.mean() > 1 - ALMOST_ALL:
        return ()
    needed = [one for _, one in chosen]
    for shared, one in reversed(chosen):
        others = [other for other in needed if other is not one]
        if shared < SURE and others and not (contains(spec, others, states) & ~inside).any():
            needed = others
    return tuple(needed)


def contains(spec: EnvironmentSpec, when: Sequence[Inequality], states: Array) -> NDArray[np.bool_]:
    """Return a mask (n,) of those of the states (n, C) that fulfil all inequalities ``when``."""
    return np.asarray(np.all([holds(spec, one, states) for one in when], axis=0))


def _faces(spec: EnvironmentSpec, terms: Sequence[Term], bounds: Array, states: Array) -> Iterator[_Face]:
    for term in terms:
        x, width = evaluate(spec, term, bounds), np.ptp(evaluate(spec, term, states))
        order = np.argsort(x, kind="stable")
        ends = np.flatnonzero(np.diff(x[order]) > LEVEL * width) + 1
        for group in np.split(order, ends):
            if len(group) >= SHARED and width > 0:
                yield _Face(term, float(np.median(x[group])), np.isin(np.arange(len(x)), group))


def _side(spec: EnvironmentSpec, face: _Face, inside: Array) -> str:
    """Return the relation, ">=" or "<=", that holds between the face's quantity and its level in all states ``inside``
    (n, C) of the region in which a reward has one of its two values; an empty string if these states lie on both sides
    of the face."""
    x = evaluate(spec, face.term, inside)
    if (x >= face.level).all():
        return ">="
    return "<=" if (x <= face.level).all() else ""


SEEK = 200  # largest number of steps from random states in the search for a second value of the reward
BATCH = 12
ENOUGH_RARE = 4  # bisections begin once this number of steps has the rarer one of the two reward values
POINTS = 12  # number of boundary points to find: twice the unknowns of an ellipsoid in three dimensions
HALVINGS = 24
COARSE = 10  # the first steps of a bisection, this many, are far enough from the boundary to test a formula for it
# To find a neighbour of a boundary point, one end of its bisection moves by this share of the states' range.
NEAR = 0.02
FLAT = 1e-3  # if a singular value is below this share of the largest one, more than one ellipsoid fits the points
# At most this number of groups of terms is tested for a common value, or an ellipsoid, at the boundary of the reward.
MOST_GROUPS = 5_000
READS: dict[Timing, Callable[[Paid], Array]] = {"after": Paid.after, "before": Paid.before}

# Function that takes steps from states (n, C) with actions (n, F), and returns those that don't end an episode.
Steps = Callable[[Array, Array], Paid]
# Function that draws n random states (n, C) and n random actions (n, F).
Drawn = Callable[[int], tuple[Array, Array]]


def threshold_reward(spec: EnvironmentSpec, seen: Paid, step: Steps, draw: Drawn) -> DeclaredReward | None:
    """Find a reward that has two values, such as a bonus near a goal. Return it if it explains all steps; None
    otherwise.

    Args:
        spec: the environment.
        seen: the steps so far, from few episodes.
        step: takes real steps.
        draw: draws states and actions for further steps.
    """
    steps = _with_both_values(seen, step, draw)
    values, counts = np.unique(steps.reward, return_counts=True)
    if len(values) != 2:
        return None
    rare, usual = (float(value) for value in values[np.argsort(counts)])
    boundary = _Boundary(steps, len(seen), steps.reward == rare, step)
    bounds = boundary.more()
    if len(bounds) < POINTS:
        return None
    for found in itertools.chain(_smooth(spec, bounds, steps, rare, usual), _boxes(spec, boundary, steps)):
        if error_of(spec, found, steps.joined(boundary.passed)) <= EXACT * abs(rare - usual):
            return found
    return None


def _smooth(spec: EnvironmentSpec, bounds: Paid, steps: Paid, rare: float, usual: float) -> Iterator[DeclaredReward]:
    """Yield possible rewards with two values. Their boundary goes through all points ``bounds``. It is an ellipsoid, or
    it is where a term of the state has one value (a level).

    Args:
        spec: the environment.
        bounds: steps next to the boundary between the two values.
        steps: other steps, which show the range of each quantity.
        rare: the reward that fewer steps have.
        usual: the other reward.
    """
    for timing, reads in READS.items():
        for group in itertools.islice(_groups(spec), MOST_GROUPS):
            for inside in regions(spec, group, reads(bounds), reads(steps)):
                yield _paying(timing, inside, rare, usual)
                yield _paying(timing, inside, usual, rare)


def _boxes(spec: EnvironmentSpec, boundary: _Boundary, steps: Paid) -> Iterator[DeclaredReward]:
    """Yield possible rewards with two values whose boundary consists of faces, like that of a box. On each face, a term
    of the state has one value (a level).

    If at least three points have the same level, there may be faces, and further points are added. A point that shares
    no level with another gets a neighbouring point, because the level that both share shows their face. If the region
    found so far contains a step with the reward that holds outside of it, a face is missing. A bisection towards this
    step finds a point of the missing face.
    """
    terms, values = _single(spec), np.unique(steps.reward)
    timings = [time for time, reads in READS.items() if has_face(spec, terms, reads(boundary.points), reads(steps))]
    if timings:
        boundary.more()
    for timing, (within, elsewhere) in itertools.product(timings, (values, values[::-1])):
        reads = READS[timing]
        for _ in range(MOST_FACES):
            boundary.beside(alone(spec, terms, reads(boundary.points), reads(steps)))
            known = steps.joined(boundary.passed)
            when = box(spec, terms, reads(boundary.points), reads(known), known.reward == within)
            if not when:
                break
            wrong = np.flatnonzero(contains(spec, when, reads(known)) & (known.reward != within))
            if not len(wrong):
                yield _paying(timing, RewardTerm(shape="one", when=when), float(within), float(elsewhere))
                break
            boundary.between(known.one(np.flatnonzero(known.reward == within)[0]), known.one(wrong[0]))


def _with_both_values(steps: Paid, step: Steps, draw: Drawn) -> Paid:
    """Take further steps until the rarer of two reward values has occurred ``ENOUGH_RARE`` times: at least one batch,
    at most ``SEEK`` steps. Returns all steps."""
    for taken in range(0, SEEK, BATCH):
        counts = np.unique(steps.reward, return_counts=True)[1]
        if len(counts) > 2 or (taken and len(counts) == 2 and counts.min() >= ENOUGH_RARE):
            break
        steps = steps.joined(step(*draw(min(BATCH, SEEK - taken))))
    return steps


class _Boundary:
    """Steps next to the boundary between two reward values, found by bisection between steps with the rarer value and
    others.

    The first ``explored`` steps come from few episodes. Those of them with the rarer value may all be close together,
    but a small part of a boundary does not show its form. So one end of most bisections is in a random state.
    """

    def __init__(self, steps: Paid, explored: int, rare: NDArray[np.bool_], step: Steps) -> None:
        # ``points``: the steps next to the boundary; ``passed``: the first steps of the bisections to find them
        self.points = self.passed = steps.at(slice(0))
        self._steps, self._step = steps, step
        self._ends: list[tuple[Paid, Paid]] = []  # the two ends of the bisection that found each point
        few, others = ([steps.one(i) for i in _spread(np.flatnonzero(of), explored)] for of in (rare, ~rare))
        self._paired = 0  # neighbours have been searched for this number of the points, beginning with the first
        self._pairs = ((few[n % len(few)], others[(n + n // len(few)) % len(others)]) for n in itertools.count())

    def more(self) -> Paid:
        """Add at most ``POINTS`` points of the boundary between the two reward values, by at most twice as many
        bisections, and return all points."""
        enough = len(self.points) + POINTS
        for one, other in itertools.islice(self._pairs, 2 * POINTS):
            self.between(one, other)
            if len(self.points) == enough:
                break
        return self.points

    def beside(self, chosen: NDArray[np.bool_]) -> None:
        """Add a neighbouring boundary point for each of the K points that ``chosen`` (K,) marks, unless an earlier call
        has done or tried this."""
        width = np.ptp(self._steps.q, axis=0)
        new = self._paired + np.flatnonzero(chosen[self._paired :])
        self._paired = len(chosen)
        for number in new:
            self.between(*self._ends[number], shift=NEAR * width * np.where(np.arange(len(width)) % 2, 1, -1))

    def between(self, one: Paid, other: Paid, shift: Array | float = 0.0) -> None:
        """Add the boundary point between two steps with different rewards, found by bisection. The state of the step
        ``other`` is first shifted by ``shift`` (C,)."""
        found = self._bisected(one, other, shift)
        self.points = self.points.joined(found)
        self._ends += [(one, other)] * len(found)

    def _bisected(self, one: Paid, other: Paid, shift: Array | float) -> Paid:
        """Return the step next to the boundary between the steps ``one`` and ``other``, found by bisection of state and
        action. The state of ``other`` is first shifted by ``shift`` (C,).

        The result is empty if a step of the bisection ends an episode, or if all its steps have the same reward. In the
        second case, one of the two ends can't be repeated exactly, or the shift has moved ``other`` across the
        boundary.
        """
        q, u, q_other, u_other = one.q[0], one.u[0], other.q[0] + shift, other.u[0]
        last, met = self._steps.at(slice(0)), set[bool]()
        for number in range(HALVINGS):
            middle, action = (q + q_other) / 2, (u + u_other) / 2
            last = self._step(middle[None], action[None])
            if not len(last):
                return last
            if number < COARSE:
                self.passed = self.passed.joined(last)
            met.add(same := bool(last.reward[0] == one.reward[0]))
            if same:
                q, u = middle, action
            else:
                q_other, u_other = middle, action
        return last if len(met) == 2 else last.at(slice(0))


def _spread(chosen: NDArray[np.int64], explored: int) -> NDArray[np.int64]:
    """Return indices of steps at which bisections may begin: all those from random states, followed by at most
    ``POINTS`` evenly spread explored steps.

    Args:
        chosen: indices of the steps to choose from.
        explored: number of explored steps, which have the smallest indices.
    """
    near, anywhere = chosen[chosen < explored], chosen[chosen >= explored]
    return np.append(anywhere, near[np.linspace(0, len(near) - 1, min(POINTS, len(near))).astype(int)])


def _groups(spec: EnvironmentSpec) -> Iterator[tuple[Term, ...]]:
    """Yield groups of one to three terms, the simplest first. The boundary of a reward may be where a single term has
    one value (a level), or an ellipsoid in the terms of a group."""
    shown = _shown(spec)
    yield from ((term,) for term in _single(spec))
    yield from itertools.combinations(shown, 2)
    yield from itertools.combinations(shown, 3)
    yield from itertools.combinations([*shown, *_differences(shown)], 2)


def _single(spec: EnvironmentSpec) -> list[Term]:
    """Return the terms that may have one value (a level) on the whole boundary of a reward: observation entries,
    coordinates, cosines and sines of angles, and differences of observation entries."""
    return [*(shown := _shown(spec)), *coordinate_terms(spec), *_differences(shown)]


def _shown(spec: EnvironmentSpec) -> list[Term]:
    return [entry.term for entry in spec.observation if entry.term.low is None and entry.term.high is None]


def _differences(shown: Sequence[Term]) -> list[Term]:
    return [one + (-1.0) * other for one, other in itertools.combinations(shown, 2)]


def regions(spec: EnvironmentSpec, group: Sequence[Term], bounds: Array, states: Array) -> Iterator[RewardTerm]:
    """Yield a reward term that is 1 on one side of the boundary between two values of a reward, and 0 on the other.
    Nothing is yielded unless the term of the group has the same value (level) at all boundary points, or all of them
    lie on one ellipsoid in its terms.

    Args:
        spec: the environment.
        group: the terms whose level or ellipsoid may be the boundary.
        bounds: K states (K, C) on the boundary.
        states: states (n, C) that show the range of each term.
    """
    x, elsewhere = (np.stack([evaluate(spec, term, q) for term in group], axis=1) for q in (bounds, states))
    if len(group) == 1 and np.ptp(x) <= LEVEL * np.ptp(elsewhere):
        level = Inequality(term=group[0], relation=">=", value=float(x.mean()))
        yield RewardTerm(shape="one", when=(level,))
    elif (of := _ellipsoid(group, x, elsewhere)) is not None:
        yield RewardTerm(shape="ball", of=of)


def _ellipsoid(group: Sequence[Term], x: Array, elsewhere: Array) -> tuple[Quantity, ...] | None:
    """Return the quantities (x_i - c_i) / r_i, whose squares have the sum 1 on the ellipsoid through all points x; None
    if there is no such ellipsoid.

    The result is also None if more than one ellipsoid goes through the points, or if all other states lie on it, as
    with the cosine and the sine of one angle.

    Args:
        group: the terms (k) that the points are values of.
        x: K points of the boundary, by the values of the k terms (K, k).
        elsewhere: the values of other states (n, k).
    """
    middle, reach = x.mean(0), x.std(0)
    if (reach <= LEVEL * np.ptp(elsewhere, axis=0)).any():
        return None
    # With z centred and scaled, 0 is inside of the ellipsoid, so its points fulfil a . z^2 + b . z = 1.
    columns, others = (np.concatenate([z**2, z], axis=1) for z in ((x - middle) / reach, (elsewhere - middle) / reach))
    weights, _, rank, _ = np.linalg.lstsq(columns, np.ones(len(x)), rcond=FLAT)
    a, b = np.split(weights, 2)
    if rank < len(weights) or np.abs(columns @ weights - 1).max() > LEVEL or a.min() <= LEVEL:
        return None
    if np.abs(others @ weights - 1).max() <= LEVEL:
        return None
    scale = np.sqrt(a / (1 + (b**2 / (4 * a)).sum())) / reach  # (k,) inverse of each of the ellipsoid's k semi-axes
    centre = middle - reach * b / (2 * a)
    return tuple(
        Quantity(term=float(s) * (term + Term.constant(-float(c))))
        for term, s, c in zip(group, scale, centre, strict=True)
    )


def _paying(timing: Timing, inside: RewardTerm, within: float, elsewhere: float) -> DeclaredReward:
    """Return a declared reward with two values: ``within`` where the term ``inside`` is 1, and ``elsewhere`` where it
    is 0. ``timing`` says whether this is the state before or after the step."""
    bonus = inside.model_copy(update={"weight": within - elsewhere})
    terms = (bonus, RewardTerm(weight=elsewhere, shape="one")) if elsewhere else (bonus,)
    return DeclaredReward(kind="declared", timing=timing, terms=terms)


def known_reward(
    counted: Counted, seen: Seen, kept: Sequence[int], spec: EnvironmentSpec, rng: np.random.Generator
) -> DeclaredReward | None:
    """Return a declared reward that is exact for all steps, or None.

    If the explored rewards have at most two values, further steps look for the boundary between the states with one
    value and those with the other. Otherwise, the reward may be a quadratic function that explains most explored steps.
    It is then fitted to further steps from random states, because the explored states may vary too little, and an
    episode may follow a schedule. Half of the further steps are for the fit, the others check it.

    Args:
        counted: a simulator that can be set exactly.
        seen: the explored steps.
        kept: indices of the variables that are coordinates.
        spec: the specification so far.
        rng: draws further states and actions.
    """
    if not isinstance(spec.action, BoxAction):
        return None
    anywhere = _Anywhere(counted, list(kept), spec, spec.action, rng)
    explored = Paid(
        wrapped(spec, seen.states[:, kept]), seen.actions, wrapped(spec, seen.next_states[:, kept]), seen.rewards
    ).at(~seen.terminated)
    if len(np.unique(explored.reward)) <= 2:
        return threshold_reward(spec, explored, anywhere.steps, anywhere.drawn)
    if not may_be_quadratic(spec, explored):
        return None
    taken = anywhere.steps(*anywhere.drawn(2 * math.ceil(ENOUGH * coefficients(spec))))
    half = len(taken) // 2
    return quadratic_reward(spec, taken.at(slice(half)), taken.at(slice(half, None)))


@dataclass(frozen=True)
class _Anywhere:
    """Draws random states and actions, sets the simulator to the states, and takes a real step from each."""

    counted: Counted
    kept: list[int]
    spec: EnvironmentSpec
    action: BoxAction
    rng: np.random.Generator

    def drawn(self, count: int) -> tuple[Array, Array]:
        """Return random states (n, C) of the sampling ranges, and random actions (n, F)."""
        low, high = np.array([limits(c.sampling) for c in self.spec.coordinates]).T
        size = count, self.action.size
        return self.rng.uniform(low, high, (count, len(low))), self.rng.uniform(self.action.low, self.action.high, size)

    def steps(self, places: Array, actions: Array) -> Paid:
        """Take steps from states (n, C) with actions (n, F), and return them without those that end an episode."""
        counted, n = self.counted, len(actions)
        read, reward = np.zeros((n, 2, len(self.kept))), np.full(n, np.nan)
        for i, (place, u) in enumerate(zip(places, actions, strict=True)):
            counted.place(self.kept, place)
            read[i, 0] = counted.read()[self.kept]
            step = counted.step(u)
            if not step.terminated:
                read[i, 1], reward[i] = counted.read()[self.kept], step.reward
        lived = np.isfinite(reward)
        return Paid(wrapped(self.spec, read[:, 0]), actions, wrapped(self.spec, read[:, 1]), reward).at(lived)
