"""Which family serves each output, the rule by which that changes, and the scores behind it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surrogym_server.errors import InvalidInput
from surrogym_server.models.port import Warm

COVERAGE_LOSS = 0.05  # it must be shown that a family is inside its intervals more seldom by at most this
ROUNDING = 1e-9
LEAST = 0.05  # nats by which a score must be better: those of intervals that are 5 % narrower
WINS = 2  # comparisons in a row that a family must win
SERVING, WON = "selected/serving", "selected/wins"  # names in a warm start


@dataclass(frozen=True)
class Standing:
    """One family on one output, compared with the family that had served it before."""

    family: str
    score: float  # log density of a held-out value in deviations of the output, in nats: mean over pieces
    better: float  # mean difference of the score from that of the family that had served
    error: float  # standard error of this difference over pieces
    coverage: float  # share of held-out values inside the 90 % interval
    wins: int = 0  # comparisons in a row that it has won
    coverage_error: float = 0.0  # standard error over pieces of its difference from the coverage of the same family

    def beats(self, other: Standing, margin: float) -> bool:
        """Whether it is clearly better than ``other``, the family that had served: by more than the margin, in standard
        errors. Its coverage must be clearly not much worse: a loss of the margin more than was seen is still allowed.
        """
        clearly = self.better > max(LEAST, margin * self.error)
        lost = other.coverage - self.coverage
        return clearly and lost + margin * self.coverage_error <= COVERAGE_LOSS + ROUNDING


@dataclass(frozen=True)
class Evidence:
    """How the candidates were compared."""

    kind: str  # ``trajectories``, ``steps``, or ``none``
    pieces: int = 0  # held out
    horizons: tuple[int, ...] = ()  # predicted steps
    folds: int = 0  # fits of each candidate
    notes: tuple[str, ...] = ()  # what was not compared, and why


@dataclass(frozen=True)
class Selection:
    """Families by output, and the last comparison."""

    candidates: tuple[str, ...]
    serving: tuple[str, ...]  # (O,)
    evidence: Evidence
    standings: tuple[tuple[Standing, ...], ...]  # of the families that were compared on each output (O,)

    def to_json(self) -> dict[str, Any]:
        """Return the selection as JSON."""
        return {
            "candidates": list(self.candidates),
            "serving": list(self.serving),
            "held_out": asdict(self.evidence)
            | {"horizons": list(self.evidence.horizons), "notes": list(self.evidence.notes)},
            "standings": [[asdict(one) for one in output] for output in self.standings],
        }

    @classmethod
    def from_json(cls, stored: Mapping[str, Any], outputs: int) -> Selection:
        """Read what ``to_json`` wrote, for a number of outputs. Raises ``InvalidInput``, ``TypeError``, ``LookupError``
        or ``ValueError`` for anything else."""
        given = stored["held_out"]
        horizons, notes = tuple(map(int, given["horizons"])), tuple(map(str, given["notes"]))
        evidence = Evidence(str(given["kind"]), int(given["pieces"]), horizons, int(given["folds"]), notes)
        standings = tuple(tuple(_standing(one) for one in output) for output in stored["standings"])
        candidates, serving = (tuple(map(str, stored[name])) for name in ("candidates", "serving"))
        if len(serving) != outputs or len(standings) != outputs or not set(serving) <= set(candidates):
            raise InvalidInput(f"expected a family out of {candidates} for each of {outputs} outputs, got {serving}")
        return cls(candidates, serving, evidence, standings)


@dataclass(frozen=True)
class Before:
    """State that one comparison leaves to the next."""

    serving: tuple[str, ...]  # (O,) families that have served so far
    wins: tuple[Mapping[str, int], ...]  # (O,) comparisons in a row that families have won
    first: bool = False  # whether nothing was compared before, so that nobody is served by a change yet


def decided(
    before: Before, compared: Sequence[Sequence[Standing]], margin: float
) -> tuple[tuple[str, ...], tuple[tuple[Standing, ...], ...]]:
    """Return the families that serve from now on (O,), and the standings with the comparisons won in a row.

    Args:
        before: what the comparison before has left.
        compared: (O,) standings of the new comparison; empty for an output that was not compared.
        margin: in standard errors.
    """
    serving, standings = [], []
    for had, wins, families in zip(before.serving, before.wins, compared, strict=True):
        known = {one.family: one for one in families}
        counted = [
            replace(one, wins=wins.get(one.family, 0) + 1 if one.beats(known[had], margin) else 0) for one in families
        ]
        able = [one for one in counted if one.wins >= (1 if before.first else WINS)]
        if able:
            had = max(able, key=lambda one: one.better).family
            counted = [replace(one, wins=0) for one in counted]  # they have won against the one before
        serving.append(had)
        standings.append(tuple(counted))
    return tuple(serving), tuple(standings)


def warm_of(selection: Selection) -> dict[str, NDArray[np.float64]]:
    """What the next comparison needs of this one, as arrays."""
    places = {name: place for place, name in enumerate(selection.candidates)}
    won = np.zeros((len(selection.serving), len(places)))
    for column, families in enumerate(selection.standings):
        for one in families:
            won[column, places[one.family]] = one.wins
    return {SERVING: np.array([float(places[name]) for name in selection.serving]), WON: won}


def from_warm(candidates: Sequence[str], outputs: int, warm: Warm) -> Before | None:
    """What ``warm_of`` has left; None if nothing of these candidates was compared before."""
    if SERVING not in warm or WON not in warm:
        return None
    serving, won = np.asarray(warm[SERVING]), np.asarray(warm[WON])
    count = len(candidates)
    if serving.shape != (outputs,) or won.shape != (outputs, count) or not set(serving.tolist()) <= set(range(count)):
        return None  # of other candidates
    families = tuple(candidates[int(place)] for place in serving)
    return Before(families, tuple({name: int(w) for name, w in zip(candidates, row, strict=True)} for row in won))


def _standing(stored: Mapping[str, Any]) -> Standing:
    score, better, error, coverage = (float(stored[name]) for name in ("score", "better", "error", "coverage"))
    coverage_error = float(stored.get("coverage_error", 0.0))  # which older files lack
    if not all(map(math.isfinite, (score, better, error, coverage, coverage_error))):
        raise InvalidInput(f"expected finite scores, got {score}, {better}, {error}, {coverage} and {coverage_error}")
    return Standing(str(stored["family"]), score, better, error, coverage, int(stored["wins"]), coverage_error)
