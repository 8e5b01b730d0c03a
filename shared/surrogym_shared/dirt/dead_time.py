"""The dead time of the actions, and the number of earlier changes that the next change depends on.

An action that is held for a step moves a plant through a response h(s), where s is the time, in steps, from the action
to the measurement. With a dead time tau, the action of j steps ago, which acts for s from j to j + 1, has the weight

    w_j = int_j^{j+1} h(s - tau) ds.

Three responses are compared: of a speed (h = 1 on [0, 1]), of a position whose speed is measured (h = 2 s on [0, 1]),
and of a position that is predicted from its last change (h = s on [0, 1], 2 - s on [1, 2]). They are the integrals of a
step of acceleration. A Gaussian process predicts each change from the state and the weighted action; the dead time and
the responses are those of the greatest evidence.

Shapes: n rows, M moving coordinates, d inputs, F action entries, K actions of each row, G dead times.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from surrogym_shared.dirt.process import Process, at, fitted
from surrogym_shared.dirt.rollouts import Array, Rollout, Rows, Sensors, rows

LONGEST = 5  # largest dead time in steps
COARSE, FINE = 0.5, 0.1  # distances of dead times that are compared: all of them, and those near the best one
MOST_CHANGES = 2  # largest number of earlier changes
FEWEST = 20  # fewest rows of a regression
ROUGH = 25  # iterations of a fit at a whole dead time
PLAUSIBLE = 2.0  # a dead time is in the interval if its evidence is smaller than the greatest by at most this
ENOUGH = 0.15  # if each change is predicted with an error of at most this share of its deviation, no more is needed
# One earlier change counts as needed if it at least halves a squared error. By averaging sensor noise, further
# measurements of a state that needs none can't halve it: the variance of a prediction falls from 2 to 1 at most.
HALF = 0.5
CLEAR = 20.0  # ... and if the logarithm of the evidence grows by at least this
LOUD = 0.3  # noise at which a search starts, as a share of a change's standard deviation
TINY = 0.02  # weights below this share of the largest count as 0


@dataclass(frozen=True)
class Explained:
    """How changes follow from states and actions.

    Attributes:
        changes: number of earlier changes among the inputs.
        delay: dead time in steps; ``low`` and ``high`` are the ends of its interval.
        gain: by how much the evidence is greater than without a dead time.
        actions: number of earlier actions on which a change depends.
        evidence: logarithm of the evidence of all M outputs.
        error: root mean square error of each left-out change (M,), as a share of its standard deviation.
        noise: standard deviation of the noise of each measurement (M,), in its unit.
        noisy: by how much the evidence of each change (M,) is greater with noise of the measurements than without.
    """

    changes: int
    delay: float
    low: float
    high: float
    gain: float
    actions: int
    evidence: float
    error: Array
    noise: Array
    noisy: Array


def explain(rollouts: Sequence[Rollout], known: Sensors) -> tuple[Explained, Explained] | None:
    """Return the regression with as few earlier changes as needed, and the one without any; None if the rollouts have
    too few rows."""
    plain = _explained(rows(rollouts, known, 0, 0, LONGEST + 1), 0)
    if plain is None or float(plain.error.max()) <= ENOUGH:
        return None if plain is None else (plain, plain)
    # the same steps for all, so that their evidences can be compared
    needed = _explained(rows(rollouts, known, 0, MOST_CHANGES, LONGEST + 1), 0)
    if needed is None:
        return None
    for past in range(1, MOST_CHANGES + 1):
        more = _explained(rows(rollouts, known, past, MOST_CHANGES, LONGEST + 1), past)
        assert more is not None
        halved = bool((more.error**2 < HALF * needed.error**2).any())
        if not halved or more.evidence < needed.evidence + CLEAR:
            break
        needed = more
    if needed.changes == 0:
        return plain, plain
    best = _explained(rows(rollouts, known, needed.changes, needed.changes, LONGEST + 1), needed.changes)
    assert best is not None
    return best, plain


def weights(response: str, delay: float, count: int) -> Array:
    """Return the weights (count,) of the action of this step and of the steps before."""
    ends = np.maximum(np.arange(count + 1) - delay, 0.0)
    if response == "speed":
        whole = np.minimum(ends, 1.0)
    elif response == "position":
        whole = np.minimum(ends, 1.0) ** 2
    else:
        ends = np.minimum(ends, 2.0)
        whole = np.where(ends < 1, ends**2 / 2, 2 * ends - ends**2 / 2 - 1)
    return np.diff(whole)


@dataclass(frozen=True)
class _Profile:
    """The evidence of each dead time (G,) for one output, its response there, and hyperparameters to begin with."""

    evidence: Array
    response: list[str]
    theta: list[Array]


@dataclass(frozen=True)
class _Compared:
    """Dead times (G,) with a profile for each of M outputs, the sum of their evidences (G,), and which outputs the
    actions matter to."""

    delays: Array
    profiles: list[_Profile]
    total: Array
    acts: list[bool]


def _explained(found: Rows, past: int) -> Explained | None:
    if len(found.change) < FEWEST:
        return None
    state, spread = _standard(found.state), found.change.std(0)
    outputs = _standard(found.change)
    if past:
        # A plant in steps, such as a simulation by Euler's method, has the response of a speed. One in time may look
        # so by chance, and would then have another dead time.
        compared = _compared(state, found.actions, outputs, ("after change",))
        stepped = _compared(state, found.actions, outputs, ("speed",))
        if stepped.total.max() > compared.total.max() + CLEAR:
            compared = stepped
    else:
        compared = _compared(state, found.actions, outputs, ("speed", "position"))
    delays, profiles, total = compared.delays, compared.profiles, compared.total
    best = int(total.argmax())
    plausible = delays[total >= total[best] - PLAUSIBLE]
    ended = [_ended(found, state, y, p, best, delays) for y, p in zip(outputs.T, profiles, strict=True)]
    used = [
        weights(profile.response[best], float(delays[best]), found.actions.shape[1])
        for profile, acts in zip(profiles, compared.acts, strict=True)
        if acts
    ]
    return Explained(
        changes=past,
        delay=float(delays[best]),
        low=float(plausible.min()),
        high=float(plausible.max()),
        gain=float(total[best] - total[0]),
        actions=max((int(np.flatnonzero(w > TINY * w.max()).max()) for w in used), default=0),
        evidence=sum(max(process.evidence for process in three) for three in ended),
        error=np.array([math.sqrt(float((plain.off**2).mean())) for plain, _, _ in ended]),
        noise=np.array([noisy.noise for _, noisy, _ in ended]) * spread,
        noisy=np.array([noisy.evidence - quiet.evidence for _, noisy, quiet in ended]),
    )


def _compared(state: Array, actions: Array, outputs: Array, responses: Sequence[str]) -> _Compared:
    """Compare dead times: first few in the whole range, and then those near the best one and 0."""
    fits = [_fits(state, actions, y, responses) for y in outputs.T]

    def profiles_at(delays: Array) -> list[_Profile]:
        return [_profile(state, actions, y, delays, fit) for y, fit in zip(outputs.T, fits, strict=True)]

    coarse = np.linspace(0.0, LONGEST, round(LONGEST / COARSE) + 1)
    rough = profiles_at(coarse)
    near = np.round(coarse[_total(rough).argmax()] + FINE * np.arange(-5, 6), 1)
    delays = np.unique([0.0, *near[(near >= 0) & (near <= LONGEST)]])
    profiles = profiles_at(delays)
    return _Compared(delays, profiles, _total(profiles), [float(np.ptp(p.evidence)) > CLEAR for p in rough])


def _total(profiles: Sequence[_Profile]) -> Array:
    total: Array = np.sum([p.evidence for p in profiles], axis=0)
    return total


_Fits = dict[tuple[str, int], Array]  # logarithms of hyperparameters, by response and whole dead time


def _fits(state: Array, actions: Array, y: Array, responses: Sequence[str]) -> _Fits:
    fits: _Fits = {}
    for name in responses:
        start = None
        for whole in range(LONGEST + 1):
            start = fits[name, whole] = fitted(_with(state, actions, name, whole), y, start, ROUGH).theta
    return fits


def _profile(state: Array, actions: Array, y: Array, delays: Array, fits: _Fits) -> _Profile:
    """Compare dead times (G,), each with the hyperparameters that were fitted at its whole neighbours."""
    evidence = np.full(len(delays), -np.inf)
    response, theta = [""] * len(delays), [np.zeros(0)] * len(delays)
    for i, delay in enumerate(delays):
        for (name, whole), start in fits.items():
            if abs(whole - delay) < 1:
                found = at(_with(state, actions, name, float(delay)), y, start).evidence
                if found > evidence[i]:
                    evidence[i], response[i], theta[i] = found, name, start
    return _Profile(evidence, response, theta)


def _ended(
    found: Rows, state: Array, y: Array, profile: _Profile, best: int, delays: Array
) -> tuple[Process, Process, Process]:
    """Return the processes of an output at the best dead time: with independent noise of the changes, with noise of the
    measurements, and without noise."""
    x = _with(state, found.actions, profile.response[best], float(delays[best]))
    plain = fitted(x, y, profile.theta[best])
    loud = plain.theta.copy()
    loud[-1] = math.log(LOUD)
    noisy = max((fitted(x, y, start, noise=found.noise) for start in (plain.theta, loud)), key=lambda p: p.evidence)
    starts = (plain.theta, None, noisy.theta)
    quiet = max((fitted(x, y, start, noiseless=True) for start in starts), key=lambda p: p.evidence)
    return plain, noisy, quiet


def _with(state: Array, actions: Array, response: str, delay: float) -> Array:
    """Return the inputs (n, d + F): the state, and the weighted actions."""
    effective = np.tensordot(actions, weights(response, delay, actions.shape[1]), (1, 0))
    return np.hstack([state, _standard(effective)])


def _standard(values: Array) -> Array:
    spread = values.std(0)
    standard: Array = (values - values.mean(0)) / np.where(spread > 0, spread, 1.0)
    return standard
