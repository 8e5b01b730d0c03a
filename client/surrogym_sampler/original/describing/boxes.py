"""Find a region that several levels bound, such as a box: all of some inequalities hold in it.

A face of the region is a level of one quantity, with the region on one side. At least two points of the boundary share
the level. Two points may do so by chance, but a few faces that hold most points don't.

Shapes: n states, K points of the boundary.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from surrogym_sampler.original.protocol import Array
from surrogym_shared.spec import EnvironmentSpec, Inequality, Term
from surrogym_shared.terms import evaluate, holds

LEVEL = 1e-5  # largest distance of a point from the boundary, as a share of the boundary's size
SHARED = 2  # points of a face, at least
SURE = 3  # points that share no level by chance
MOST_FACES = 6
ALMOST_ALL = 0.75  # of the points: the others may lie where the state jumps, as at a contact


@dataclass(frozen=True)
class _Face:
    term: Term
    level: float
    points: NDArray[np.bool_]  # of the boundary that lie on it (K,)


def has_face(spec: EnvironmentSpec, terms: Sequence[Term], bounds: Array, states: Array) -> bool:
    """Whether three of the points ``bounds`` (K, C) share a level of one of the terms, whose ranges ``states`` (n, C)
    give."""
    return any(face.points.sum() >= SURE for face in _faces(spec, terms, bounds, states))


def alone(spec: EnvironmentSpec, terms: Sequence[Term], bounds: Array, states: Array) -> NDArray[np.bool_]:
    """Which of the points ``bounds`` (K, C) share no level with another."""
    left = np.ones(len(bounds), dtype=bool)
    for face in _faces(spec, terms, bounds, states):
        left &= ~face.points
    return left


def box(
    spec: EnvironmentSpec, terms: Sequence[Term], bounds: Array, states: Array, inside: NDArray[np.bool_]
) -> tuple[Inequality, ...]:
    """Inequalities that all hold in the region, and that most points of its boundary touch; empty if there are none.

    A face of two points is left out if the others already exclude all states outside.

    Args:
        spec: the environment.
        terms: quantities that may have levels.
        bounds: points of the boundary (K, C).
        states: other states (n, C).
        inside: which of them are in the region (n,).
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
    """Which of the states (n, C) are in the region."""
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
    """The relation that holds for all states (n, C) of the region, or an empty string if they lie on both sides."""
    x = evaluate(spec, face.term, inside)
    if (x >= face.level).all():
        return ">="
    return "<=" if (x <= face.level).all() else ""
