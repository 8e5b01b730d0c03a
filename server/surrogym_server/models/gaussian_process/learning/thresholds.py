"""Search for thresholds that explain which of several labelled states lie inside a region, and for alternatives.

As few axes as possible have a threshold. If a threshold has a uniform prior over the range of its axis, the probability
of labels that it separates is gap / range: the gap between the nearest states inside and outside, divided by the range.
This is the weight of a threshold (cut) among the alternatives that explain the same samples.
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
SLACK = 1e-9  # two values on an axis count as equal if they differ by at most this share of the axis's range
RIVALS = 4  # at most this many alternative thresholds on different axes are kept that explain the same samples
FAINT = 0.05  # an alternative threshold is discarded if its probability is below this
LEFT_OUT = 100  # to test thresholds, at most this many samples are left out and predicted, one by one


def thresholds(definition: EnvironmentDefinition, q: Tensor, inside: Tensor) -> list[tuple[Thresholds, float]]:
    """Find thresholds that explain for which of the states q (n, C) ``inside`` (n,) is true.

    Returns:
        At most two pairs (thresholds, leave-one-out log probability). In the first, a state is inside if it exceeds any
        of the thresholds. In the second, a state is inside if it exceeds none of at least two thresholds. With a single
        threshold, the second would be the same region as the first.
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
    """Return rules that explain the labels ``inside`` (n,) of n states by their values on A axes (n, A): a state is
    inside if it exceeds the threshold of any rule. Return () if no rules explain all labels."""
    if inside.all() or not inside.any():
        return ()
    width = np.maximum(values.max(0) - values.min(0), 1e-300)
    outside = values[~inside].max(0)
    # (i, A) for each of i states inside and each of A axes, whether the state exceeds all states outside on the axis.
    reached = values[inside] > outside + SLACK * width
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
    """Return the log probability of labels ``inside`` (n,), if each is predicted to be true with ``probability`` (n,).
    The probability of each label counts as at least 1 / (n + 2), as in the rule of succession."""
    right = torch.where(inside, probability, 1 - probability)
    return float(right.clamp(1 / (len(right) + 2), 1).log().sum())


def _cover(reached: Bools, share: Floats) -> list[int]:
    """Choose few of A axes, greedily, so that each of i samples inside is separated from all samples outside by a
    threshold on at least one chosen axis. Return the indices of these axes; [] if this is impossible.

    Args:
        reached: (i, A) whether a sample inside exceeds all samples outside on an axis.
        share: (i, A) gap between the sample and those outside, as a share of the axis's range. Of axes that separate
            equally many further samples, the axis with the widest gap is chosen.
    """
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
    """Return for each of i samples inside the position in ``axes`` of the axis whose threshold explains the sample,
    (i,). ``reached`` (i, A) says whether a sample exceeds all samples outside on an axis, and ``share`` (i, A) by which
    share of the axis's range.

    If several axes are possible, it is the axis on which the sample lies farthest beyond the samples outside. On each
    axis this distance is divided by the smallest distance of the samples that only this axis explains.
    """
    able, distance = reached[:, axes], share[:, axes]
    sole = able.sum(1) == 1
    nearest = np.where(sole[:, None] & able, distance, np.inf).min(0, initial=np.inf)
    ratio = np.where(able, distance / np.where(np.isfinite(nearest), nearest, 1.0), -np.inf)
    return np.asarray(ratio.argmax(1))


def _rivals(inner: Floats, outside: Floats, width: Floats, own: Bools, axes: list[int]) -> tuple[Cut, ...]:
    """Return alternative cuts (thresholds on one axis each), by descending weight. Each separates the samples of one
    rule from those outside.

    Args:
        inner: axis values (i, A) of the samples inside.
        outside: greatest value of the samples outside on each axis, (A,).
        width: range of each axis, (A,).
        own: (i,) bool, the samples inside that the rule explains.
        axes: indices of the axes to consider.
    """
    inside = inner[own].min(0)
    weights = {axis: max(0.0, float((inside[axis] - outside[axis]) / width[axis])) for axis in axes}
    weights = {axis: weight for axis, weight in weights.items() if weight > SLACK}
    best = sorted(weights, key=lambda axis: -weights[axis])[:RIVALS]
    total = sum(weights[axis] for axis in best)
    best = [axis for axis in best if weights[axis] >= FAINT * total]
    total = sum(weights[axis] for axis in best)
    return tuple(Cut(axis, float(outside[axis]), float(inside[axis]), weights[axis] / total) for axis in best)


def _left_out(definition: EnvironmentDefinition, values: Floats, inside: Bools) -> float:
    """Return the leave-one-out log probability of the labels ``inside`` (n,) under rules that are learned from the
    values (n, A) of n samples on A axes.

    If there are more than ``LEFT_OUT`` (100) samples, only this number of evenly spaced samples is left out, and the
    result is scaled up to all samples.
    """
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
