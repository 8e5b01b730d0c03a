"""Search for a region of states that several inequalities bound, such as a box, given points of its boundary.

A face is the part of the boundary where one quantity has one value (its level); the region is on one side of it. A face
has at least two points of the boundary. Two points may share a level by chance, but a few faces that hold most points
don't.

Shapes: n states, K points of the boundary, C coordinates.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from surrogym_sampler.original.protocol import Array
from surrogym_shared.spec import EnvironmentSpec, Inequality, Term
from surrogym_shared.terms import evaluate, holds

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
    """Return whether at least three points of the boundary have the same value (level) of some quantity, as the points
    of a face of a box have.

    Args:
        spec: the environment.
        terms: quantities by which the points are compared.
        bounds: K points of the boundary (K, C).
        states: states (n, C) that show the range of each quantity.
    """
    return any(face.points.sum() >= SURE for face in _faces(spec, terms, bounds, states))


def alone(spec: EnvironmentSpec, terms: Sequence[Term], bounds: Array, states: Array) -> NDArray[np.bool_]:
    """Return a mask (K,) of those of K boundary points that share the value (level) of no quantity with another point.

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
    """Return inequalities that describe a region, such as a box; empty if there are none. All of them hold inside. At
    most points of the boundary, a quantity has the limiting value of one of them, so the point lies on a face.

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
    (n, C) of the region; an empty string if these states lie on both sides of the face."""
    x = evaluate(spec, face.term, inside)
    if (x >= face.level).all():
        return ">="
    return "<=" if (x <= face.level).all() else ""
