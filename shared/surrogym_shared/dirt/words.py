"""What was found in rollouts, in words, and what to declare in the specification."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from surrogym_shared.dirt import Dirt, turns
from surrogym_shared.dirt.rollouts import Rollout, Sensors, changes
from surrogym_shared.spec import EnvironmentSpec

CERTAIN = 10.0  # logarithm of odds that are called certain
USUAL = 0.05  # tolerance of a coordinate without a declared one, as a share of the standard deviation of its changes
WIDER = 1.5  # the declared largest change of a coordinate is this multiple of its largest observed change


def traits(
    found: Dirt, known: Sensors, spec: EnvironmentSpec, rollouts: Sequence[Rollout]
) -> Iterator[tuple[str, str]]:
    """Yield a name and a sentence for each kind of dirt, except for the history that is needed."""
    spread = np.concatenate([changes(rollout, known.turning) for rollout in rollouts]).std(0)
    allowed = {n: spec.tolerances.get(n, USUAL * std) for n, std in zip(known.names, spread, strict=True)}
    if (delay := found.delay) is not None:
        seconds = f" ({delay.steps * spec.sampling_period:.2g} s)" if spec.sampling_period else ""
        said = (
            f"actions take effect {delay.steps:.1f} steps late{seconds}, between {delay.low:.1f} and {delay.high:.1f}"
        )
        yield "dead time", f"{said}; {_sure(delay.odds)}"
    for name, width in found.encoders.items():
        circle = f", {turns(width)} counts in a turn" if known.turning[known.names.index(name)] else ""
        yield "encoder", f"{name} is read in steps of {width:.3g}{circle}; certain{_tolerance(name, width, allowed)}"
    for name, stuck in found.stiction.items():
        most = ", ".join(f"{most:.2g}" for most in stuck.under)
        said = (
            f"{name} rested in {stuck.steps} steps under actions of up to {most}: friction that sticks, or a dead zone"
        )
        yield "stiction", f"{said}; {_sure(-np.log(max(stuck.chance, 1e-300)))}"
    for name, noise in found.noise.items():
        share = 100 * noise.std / known.span[known.names.index(name)]
        said = f"a measurement of {name} has a standard deviation of {noise.std:.2g}, {share:.2g} % of its range"
        yield "noise", f"{said}; {_sure(noise.odds)}{_tolerance(name, noise.std, allowed)}"


def history_call(found: Dirt, known: Sensors, rollouts: Sequence[Rollout]) -> str:
    """Return the call of ``with_history`` that declares the history that was found, as source text."""
    past = 0 if found.explained is None else found.explained.changes
    change = np.concatenate([changes(rollout, known.turning) for rollout in rollouts])
    most = zip(known.names, WIDER * np.abs(change).max(0), known.moving, strict=True)
    largest = ", ".join(f'"{name}": {widest:.2g}' for name, widest, moves in most if moves)
    named = f", largest={{{largest}}}" if past else ""
    return f"with_history(spec, changes={past}, actions={found.actions}{named})"


def declared(spec: EnvironmentSpec) -> tuple[int, int]:
    """Return the number of earlier changes and of earlier actions that the specification declares as coordinates
    (lags)."""
    ages: dict[str, tuple[int, int]] = {}
    for c in spec.coordinates:
        if c.lag is not None and c.lag.kind != "steps":
            before = ages.get(c.lag.of or "", (0, 0))
            of_action = c.lag.kind == "action" or before[1] > 0
            ages[c.name] = (before[0] + (not of_action), before[1] + of_action)
    return max((a for a, _ in ages.values()), default=0), max((b for _, b in ages.values()), default=0)


def _sure(odds: float) -> str:
    return "certain" if odds >= CERTAIN else "likely"


def _tolerance(name: str, error: float, allowed: Mapping[str, float]) -> str:
    """Return the advice to declare a tolerance of at least the error of one measurement; empty if ``allowed`` is."""
    if error <= allowed[name]:
        return ""
    return f'; declare a tolerance of at least that, such as tolerances={{"{name}": {error:.2g}}}'
