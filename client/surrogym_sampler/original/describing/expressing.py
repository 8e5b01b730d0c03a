"""Expression of observation entries as weighted sums of 1, coordinates, and sines and cosines of (sums of) angles.

Shapes: n states, C coordinates, D observation entries.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np

from surrogym_sampler.original.protocol import Array
from surrogym_shared.spec import EnvironmentSpec, ObservationEntry, Term
from surrogym_shared.terms import evaluate

# A term expresses an observation entry if it differs by at most this share of the entry's largest value.
TOLERANCE = 1e-7
DIGITS = 6  # weights rounded to this number of decimals are preferred, if they still give the observation exactly
FEW_TURNS = 4  # with at most this number of angles, the cosine and sine of sums of three angles are tried as well
CLIPPED = 0.02  # an observation entry is clipped at an end of its range if this share of the states has that value


def express(
    frame: EnvironmentSpec, turning: Sequence[str], coordinates: Array, observed: Array
) -> list[ObservationEntry | None]:
    """Express the entries of an observation as terms of the coordinates; None for an entry that never changes or can't
    be expressed.

    Args:
        frame: a specification, of which only the coordinates are used.
        turning: names of coordinates that enter by their sine and cosine.
        coordinates: states (n, C).
        observed: the observations in these states (n, D).
    """
    basis = _basis(frame, turning)
    design = np.stack([evaluate(frame, term, coordinates) for term in basis], axis=1)
    found: list[ObservationEntry | None] = []
    for index, entry in enumerate(observed.T):
        tolerance = TOLERANCE * max(1.0, float(np.abs(entry).max()))
        if np.ptp(entry) <= tolerance:
            found.append(None)
            continue
        weights = _weights(design, entry, tolerance)
        term = _clip_of(frame, coordinates, entry) if weights is None else _sum(basis, weights)
        found.append(None if term is None else ObservationEntry(name=_name_of(term) or f"o{index}", term=term))
    return found


def shown_by_itself(name: str, *, angle: bool) -> list[ObservationEntry]:
    """Return the observation entries that show a coordinate directly: its value, or the cosine and sine of an angle."""
    if not angle:
        return [ObservationEntry(name=name, term=Term.linear(**{name: 1.0}))]
    pairs = (("cos", Term.cos(**{name: 1.0})), ("sin", Term.sin(**{name: 1.0})))
    return [ObservationEntry(name=f"{function}_{name}"[:64], term=term) for function, term in pairs]


def names_in(term: Term) -> set[str]:
    """Return the names of the coordinates that a term reads."""
    return {name for part in term.parts for name in part.weights}


def _basis(frame: EnvironmentSpec, turning: Sequence[str]) -> list[Term]:
    linear = [Term.linear(**{name: 1.0}) for name in frame.coordinate_names]
    most = 3 if len(turning) <= FEW_TURNS else 2
    sums = [dict.fromkeys(chosen, 1.0) for n in range(1, most + 1) for chosen in itertools.combinations(turning, n)]
    circular = [term for weights in sums for term in (Term.sin(**weights), Term.cos(**weights))]
    return [Term.constant(1.0), *linear, *circular]


def _weights(design: Array, entry: Array, tolerance: float) -> Array | None:
    """Return weights (b,) with which b basis terms, whose values at n states are ``design`` (n, b), give an observation
    entry (n,) with an error of at most ``tolerance``; None if no weights do.

    An observation in single precision has rounding errors, which many terms together would explain too. So a single
    term is tried first, then rounded weights of all terms, then exact ones.
    """
    single = np.round(design.T @ entry / np.maximum((design**2).sum(0), TOLERANCE), DIGITS)
    best = int(np.abs(design * single - entry[:, None]).max(0).argmin())
    all_of_them = np.asarray(np.linalg.lstsq(design, entry, rcond=None)[0], dtype=np.float64)
    alone: Array = np.where(np.arange(len(single)) == best, single, 0.0)
    tried: tuple[Array, ...] = (alone, np.round(all_of_them, DIGITS), all_of_them)
    return next((weights for weights in tried if np.abs(design @ weights - entry).max() <= tolerance), None)


def _sum(basis: Sequence[Term], weights: Array) -> Term | None:
    kept = [(term, float(np.round(w, 9))) for term, w in zip(basis, weights, strict=True) if abs(w) > TOLERANCE]
    parts = tuple(part for term, weight in kept for part in (weight * term).parts)
    return Term(parts=parts) if 0 < len(parts) <= 64 else None


def _clip_of(frame: EnvironmentSpec, coordinates: Array, entry: Array) -> Term | None:
    """Return the term of an observation entry that is one coordinate, clipped to the entry's smallest and largest
    value; None if the entry is not of this kind. ``entry`` (n,) has its values in n states with ``coordinates`` (n, C),
    whose names ``frame`` has."""
    low, high = float(entry.min()), float(entry.max())
    for index, name in enumerate(frame.coordinate_names):
        if np.allclose(np.clip(coordinates[:, index], low, high), entry, atol=TOLERANCE):
            ends = [end if (entry == end).mean() > CLIPPED else None for end in (low, high)]
            return Term.linear(**{name: 1.0}).clipped(*ends)
    return None


def _name_of(term: Term) -> str | None:
    """Return the name of an observation entry whose term is one coordinate, its sine or its cosine; None for other
    terms."""
    if len(term.parts) != 1 or len(term.parts[0].weights) != 1 or term.parts[0].coefficient != 1.0:
        return None
    (name,) = term.parts[0].weights
    return name if term.parts[0].function == "linear" else f"{term.parts[0].function}_{name}"[:64]
