"""Find a reward of two values that changes at a level of an observation entry, or at an ellipsoid of some entries.

Bonuses for being near a goal or above a height are of this kind. Bisections between a step with one value and a step
with the other give points x of the boundary. One end of most bisections is in a random state, so that the points
lie on all sides. A form is found if all points satisfy

    x_i = level,   or   sum_i ((x_i - c_i) / r_i)^2 = 1

where x holds one to three entries, and if it gives the reward of every other step.

Shapes: n steps, C coordinates, F action entries, K points of the boundary, k entries.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from surrogym_client.original.describing.probing import EXACT
from surrogym_client.original.describing.rewarding import Paid, error_of
from surrogym_client.original.protocol import Array
from surrogym_shared.spec import DeclaredReward, EnvironmentSpec, Inequality, Quantity, RewardTerm, Term
from surrogym_shared.terms import evaluate

SEEK = 200  # most steps from random states that look for the second value
BATCH = 12
ENOUGH = 4  # steps with the rarer value, at which bisections begin
POINTS = 12  # of the boundary: twice the numbers of an ellipsoid of three entries
HALVINGS = 24
LEVEL = 1e-5  # largest distance of a point from the boundary, as a share of the boundary's size
FLAT = 1e-3  # a share of the largest singular value: with one below it, points lie on more than one ellipsoid
MOST = 5_000  # groups of entries

Steps = Callable[[Array, Array], Paid]  # from states (n, C) with actions (n, F), without those that end an episode
Drawn = Callable[[int], tuple[Array, Array]]  # n random states (n, C) and actions (n, F)


def threshold_reward(spec: EnvironmentSpec, seen: Paid, step: Steps, draw: Drawn) -> DeclaredReward | None:
    """Find a reward of two values, and return it if it explains all steps; None otherwise.

    Args:
        spec: the environment.
        seen: steps so far, of few episodes.
        step: takes real steps.
        draw: draws states and actions for further steps.
    """
    steps = _with_both_values(seen, step, draw)
    values, counts = np.unique(steps.reward, return_counts=True)
    if len(values) != 2:
        return None
    rare, usual = (float(value) for value in values[np.argsort(counts)])
    bounds = _boundary(steps, len(seen), steps.reward == rare, step)
    if len(bounds) < POINTS:
        return None
    for timing in ("after", "before"):
        reads = Paid.after if timing == "after" else Paid.before
        for group in itertools.islice(_groups(spec), MOST):
            for inside in regions(spec, group, reads(bounds), reads(steps)):
                for terms in (_paying(inside, rare, usual), _paying(inside, usual, rare)):
                    found = DeclaredReward(kind="declared", timing=timing, terms=terms)
                    if error_of(spec, found, steps) <= EXACT * abs(rare - usual):
                        return found
    return None


def _with_both_values(steps: Paid, step: Steps, draw: Drawn) -> Paid:
    """Take a batch of further steps, and then up to ``SEEK`` until the rarer of two values was met ``ENOUGH`` times."""
    for taken in range(0, SEEK, BATCH):
        counts = np.unique(steps.reward, return_counts=True)[1]
        if len(counts) > 2 or (taken and len(counts) == 2 and counts.min() >= ENOUGH):
            break
        steps = steps.joined(step(*draw(min(BATCH, SEEK - taken))))
    return steps


def _boundary(steps: Paid, explored: int, rare: NDArray[np.bool_], step: Steps) -> Paid:
    """Steps next to the boundary (K,), by bisection between steps with the rare value and others, in pairs.

    The first ``explored`` steps are those of few episodes. All of them that have the rare value may be neighbours, and
    a small part of a boundary does not tell its form. So one end of most bisections is in a random state.
    """
    few, others = _spread(np.flatnonzero(rare), explored), _spread(np.flatnonzero(~rare), explored)
    found = steps.at(slice(0))
    for number in range(2 * POINTS):
        if len(found) >= POINTS:
            break
        one, other = few[number % len(few)], others[(number + number // len(few)) % len(others)]
        found = found.joined(_bisected(steps, one, other, step))
    return found


def _spread(chosen: NDArray[np.int64], explored: int) -> NDArray[np.int64]:
    """Indices of the steps from random states, and then of at most ``POINTS`` explored ones, evenly spread."""
    near, anywhere = chosen[chosen < explored], chosen[chosen >= explored]
    return np.append(anywhere, near[np.linspace(0, len(near) - 1, min(POINTS, len(near))).astype(int)])


def _bisected(steps: Paid, one: int, other: int, step: Steps) -> Paid:
    """The step next to the boundary between two steps, with state and action between theirs.

    None if a step ends an episode, or all have the same reward: then one of the two steps can't be repeated exactly.
    """
    (q, u), (q_other, u_other) = (steps.q[one], steps.u[one]), (steps.q[other], steps.u[other])
    last, met = steps.at(slice(0)), set[bool]()
    for _ in range(HALVINGS):
        middle, action = (q + q_other) / 2, (u + u_other) / 2
        last = step(middle[None], action[None])
        if not len(last):
            return last
        met.add(same := bool(last.reward[0] == steps.reward[one]))
        if same:
            q, u = middle, action
        else:
            q_other, u_other = middle, action
    return last if len(met) == 2 else last.at(slice(0))


def _groups(spec: EnvironmentSpec) -> Iterator[tuple[Term, ...]]:
    """Groups of one to three terms whose level may be the boundary, the simplest ones first."""
    shown = [entry.term for entry in spec.observation if entry.term.low is None and entry.term.high is None]
    own: list[Term] = []
    for coordinate in spec.coordinates:
        own.append(Term.linear(**{coordinate.name: 1.0}))
        if coordinate.kind == "angle":
            own += [Term.cos(**{coordinate.name: 1.0}), Term.sin(**{coordinate.name: 1.0})]
    differences = [one + (-1.0) * other for one, other in itertools.combinations(shown, 2)]
    yield from ((term,) for term in [*shown, *own, *differences])
    yield from itertools.combinations(shown, 2)
    yield from itertools.combinations(shown, 3)
    yield from itertools.combinations([*shown, *differences], 2)


def regions(spec: EnvironmentSpec, group: Sequence[Term], bounds: Array, states: Array) -> Iterator[RewardTerm]:
    """Terms that are 1 on one side of the boundary, if the points ``bounds`` (K, C) of it agree.

    ``states`` (n, C) give the size of an entry's range.
    """
    x, elsewhere = (np.stack([evaluate(spec, term, q) for term in group], axis=1) for q in (bounds, states))
    if len(group) == 1 and np.ptp(x) <= LEVEL * np.ptp(elsewhere):
        level = Inequality(term=group[0], relation=">=", value=float(x.mean()))
        yield RewardTerm(shape="one", when=(level,))
    elif (of := _ellipsoid(group, x, elsewhere)) is not None:
        yield RewardTerm(shape="ball", of=of)


def _ellipsoid(group: Sequence[Term], x: Array, elsewhere: Array) -> tuple[Quantity, ...] | None:
    """The quantities (x_i - c_i) / r_i of an ellipsoid through the points x (K, k), or None.

    None also if other ellipsoids go through them, or if all other states are on it: x holds ``elsewhere`` (n, k) there.
    A cosine and a sine do this.
    """
    middle, reach = x.mean(0), x.std(0)
    if (reach <= LEVEL * np.ptp(elsewhere, axis=0)).any():
        return None
    # 0 is inside of the ellipsoid, so a . z^2 + b . z = 1 on it, where z is centred and scaled
    columns, others = (np.concatenate([z**2, z], axis=1) for z in ((x - middle) / reach, (elsewhere - middle) / reach))
    weights, _, rank, _ = np.linalg.lstsq(columns, np.ones(len(x)), rcond=FLAT)
    a, b = np.split(weights, 2)
    if rank < len(weights) or np.abs(columns @ weights - 1).max() > LEVEL or a.min() <= LEVEL:
        return None
    if np.abs(others @ weights - 1).max() <= LEVEL:
        return None
    scale = np.sqrt(a / (1 + (b**2 / (4 * a)).sum())) / reach  # 1 / r
    centre = middle - reach * b / (2 * a)
    return tuple(
        Quantity(term=float(s) * (term + Term.constant(-float(c))))
        for term, s, c in zip(group, scale, centre, strict=True)
    )


def _paying(inside: RewardTerm, within: float, elsewhere: float) -> tuple[RewardTerm, ...]:
    """Terms of a reward of two values."""
    bonus = inside.model_copy(update={"weight": within - elsewhere})
    return (bonus, RewardTerm(weight=elsewhere, shape="one")) if elsewhere else (bonus,)
