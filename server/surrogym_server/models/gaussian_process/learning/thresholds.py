"""Search for thresholds from labelled states: the fewest axes that explain which states lie inside, and alternatives.

If the level has a uniform prior over an axis's range, the probability of labels that it separates is gap / range. This
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
SLACK = 1e-9  # values closer than this share of an axis's range are equal
RIVALS = 4  # greatest number of alternative cuts (thresholds on different axes) that explain the same samples
FAINT = 0.05  # alternative cuts with a smaller weight than this are discarded
LEFT_OUT = 100  # greatest number of samples that are left out, one by one, to test how well thresholds predict labels


def thresholds(definition: EnvironmentDefinition, q: Tensor, inside: Tensor) -> list[tuple[Thresholds, float]]:
    """Find thresholds that explain which of the states q (n, C) lie inside, (n,) bool.

    Returns:
        At most two pairs (thresholds, leave-one-out log probability). In the first, a state is inside if it exceeds any
        of the thresholds. In the second, it is inside if it exceeds none of at least two thresholds. With only one, the
        second would be the same kind as the first.
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
    inside if it exceeds the threshold of any rule. Return () if no such rules fit."""
    if inside.all() or not inside.any():
        return ()
    width = np.maximum(values.max(0) - values.min(0), 1e-300)
    outside = values[~inside].max(0)
    # (i, A) whether each state inside exceeds all states outside on each axis.
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
    """Return the log probability of labels ``inside`` (n,) that are predicted with ``probability`` (n,). The
    probability of each label counts as at least 1 / (n + 2), as in the rule of succession."""
    right = torch.where(inside, probability, 1 - probability)
    return float(right.clamp(1 / (len(right) + 2), 1).log().sum())


def _cover(reached: Bools, share: Floats) -> list[int]:
    """Choose few axes, greedily, so that each of the i samples inside is separated from all samples outside by a
    threshold on at least one of them. Return their indices; [] if this is impossible.

    Args:
        reached: (i, A) whether a sample inside exceeds all samples outside on an axis.
        share: (i, A) gap between the sample and those outside, as a share of the axis's range. Of axes that separate
            equally many further samples, the one with the widest gap is chosen.
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
    """Return for each of the i samples inside the position in ``axes`` of the axis whose threshold explains it, (i,).

    If several axes are possible, it is the one on which the sample lies farthest beyond the samples outside. On each
    axis this distance is divided by the smallest distance of the samples that only this axis explains. ``reached`` and
    ``share`` are as in ``_cover``.
    """
    able, distance = reached[:, axes], share[:, axes]
    sole = able.sum(1) == 1
    nearest = np.where(sole[:, None] & able, distance, np.inf).min(0, initial=np.inf)
    ratio = np.where(able, distance / np.where(np.isfinite(nearest), nearest, 1.0), -np.inf)
    return np.asarray(ratio.argmax(1))


def _rivals(inner: Floats, outside: Floats, width: Floats, own: Bools, axes: list[int]) -> tuple[Cut, ...]:
    """Return alternative cuts (thresholds on one axis) that all separate the samples of one rule from those outside, by
    descending weight.

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
    """Return the leave-one-out log probability of the labels ``inside`` (n,), given axis values (n, A).

    If there are more than ``LEFT_OUT`` samples, only so many evenly spaced ones are left out, and the result is scaled
    up to all samples.
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
