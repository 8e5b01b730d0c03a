"""Search for thresholds from labelled states: the fewest axes that explain which states lie inside, and alternatives.

If the level is a priori uniform over an axis' range, the probability of labels that it separates is gap / range. This
is the weight of a cut among those that explain the same samples.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.models.gaussian_process.prediction.regions import Axes, Cut, Thresholds

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
Rules = tuple[tuple[Cut, ...], ...]
SLACK = 1e-9  # of an axis' range: closer values are the same
RIVALS = 4
FAINT = 0.05  # alternatives of less weight are dropped
LEFT_OUT = 100  # samples left out, one by one, to score a rule


def thresholds(definition: EnvironmentDefinition, q: Tensor, inside: Tensor) -> list[tuple[Thresholds, float]]:
    """Find thresholds that explain which of q (n, C) lie inside (n,), and their leave-one-out log probabilities.

    A union of them, a complement of a union of two or more (of one would be the same again), both or none.
    """
    values, labels = Axes.of(definition)(q).numpy(), inside.numpy()
    forms = []
    for complement in (False, True):
        targets = ~labels if complement else labels
        rules = explain(values, targets)
        if len(rules) > complement:
            forms.append((Thresholds(definition, rules, complement), _left_out(definition, values, targets)))
    return forms


def explain(values: Floats, inside: Bools) -> Rules:
    """Rules for the labels inside (n,) of samples with axis values (n, A); none if no union of thresholds fits."""
    if inside.all() or not inside.any():
        return ()
    width = np.maximum(values.max(0) - values.min(0), 1e-300)
    outside = values[~inside].max(0)
    reached = values[inside] > outside + SLACK * width  # (i, A)
    share = np.where(reached, (values[inside] - outside) / width, np.inf)
    axes = _cover(reached, share)
    if not axes:
        return ()
    assigned = _assign(reached, share, axes)
    free = [axis for axis in range(values.shape[1]) if axis not in axes]
    return tuple(
        _rivals(values[inside], outside, width, assigned == place, [axis, *free])
        for place, axis in enumerate(axes)
        if (assigned == place).any()
    )


def log_probability(probability: Tensor, inside: Tensor) -> float:
    """Log probability of labels inside (n,), limited by the rule of succession, 1 / (n + 2)."""
    right = torch.where(inside, probability, 1 - probability)
    return float(right.clamp(1 / (len(right) + 2), 1).log().sum())


def _cover(reached: Bools, share: Floats) -> list[int]:
    """Axes that together reach every sample, chosen greedily. Of axes that reach as many, the one with the
    widest gap."""
    axes: list[int] = []
    left = np.ones(len(reached), dtype=bool)
    while left.any():
        counts = reached[left].sum(0)
        if counts.max() == 0:
            return []
        gap = np.where(counts == counts.max(), np.where(reached[left], share[left], np.inf).min(0), -np.inf)
        axes.append(int(gap.argmax()))
        left &= ~reached[:, axes[-1]]
    return axes


def _assign(reached: Bools, share: Floats, axes: list[int]) -> NDArray[np.int64]:
    """Axis that explains each sample (i,): the only possible one, or the one beyond which it lies farthest, relative to
    the samples that this axis alone explains."""
    able, distance = reached[:, axes], share[:, axes]
    sole = able.sum(1) == 1
    nearest = np.where(sole[:, None] & able, distance, np.inf).min(0, initial=np.inf)
    ratio = np.where(able, distance / np.where(np.isfinite(nearest), nearest, 1.0), -np.inf)
    return np.asarray(ratio.argmax(1))


def _rivals(inner: Floats, outside: Floats, width: Floats, own: Bools, axes: list[int]) -> tuple[Cut, ...]:
    """Cuts along ``axes`` that explain a rule's own samples, by weight."""
    inside = inner[own].min(0)
    weights = {axis: max(0.0, float((inside[axis] - outside[axis]) / width[axis])) for axis in axes}
    weights = {axis: weight for axis, weight in weights.items() if weight > SLACK}
    best = sorted(weights, key=lambda axis: -weights[axis])[:RIVALS]
    total = sum(weights[axis] for axis in best)
    best = [axis for axis in best if weights[axis] >= FAINT * total]
    total = sum(weights[axis] for axis in best)
    return tuple(Cut(axis, float(outside[axis]), float(inside[axis]), weights[axis] / total) for axis in best)


def _left_out(definition: EnvironmentDefinition, values: Floats, inside: Bools) -> float:
    """Leave-one-out log probability of the labels. If there are more than ``LEFT_OUT`` samples, an even share
    represents all."""
    count, rows = len(inside), torch.from_numpy(values)
    picked = np.unique(np.linspace(0, count - 1, min(count, LEFT_OUT)).astype(int))
    probabilities = torch.full((len(picked),), float(inside.mean() > 0.5), dtype=torch.float64)
    for place, index in enumerate(picked):
        others = np.arange(count) != index
        rules = explain(values[others], inside[others])
        if rules:
            probabilities[place] = Thresholds(definition, rules).at(rows[index : index + 1])[0]
    score = log_probability(probabilities, torch.from_numpy(inside[picked]))
    return score * count / len(picked)
