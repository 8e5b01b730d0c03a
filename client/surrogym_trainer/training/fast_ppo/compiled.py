"""One update of PPO in compiled code. It computes what the update of Stable-Baselines3 does.

A batch passes through the networks in blocks of rows, so that activations stay in the processor's cache. BLAS computes
the matrix products. All arrays are float32.

Shapes: B rows of a batch, n of a block, I inputs and O outputs of a layer, A outputs of the actor, F action entries, K
further parameters, P parameters.
"""

from __future__ import annotations

import math

import numpy as np
import scipy.linalg.cython_blas  # noqa: F401  # numba calls it; loaded now, its threads can be limited
from numba import types
from numpy.typing import NDArray

from surrogym_shared.compiled.jit import compiled, entry, inlined, summing
from surrogym_shared.distributions import HALF_LOG_TAU

Floats = NDArray[np.float32]
Ints = NDArray[np.int64]

FIRST_DECAY, SECOND_DECAY, EPSILON = 0.9, 0.999, 1e-5  # of Adam, with the values of Stable-Baselines3
BLOCK = 128  # number of rows of a batch that pass through the networks together; 64 and 256 were slower
LARGEST_TANH = np.float32(7.90531110763549805)  # for larger arguments, tanh is 1 in float32
NONE, ONE, HALF = np.float32(0), np.float32(1), np.float32(0.5)
CONSTANT = np.float32(HALF_LOG_TAU)

VECTOR, ROWS = types.float32[::1], types.float32[:, ::1]
SIZES = types.int64[::1]


@inlined
def bent(x: np.float32) -> np.float32:
    """Return tanh x to 4 units in the last place, by the rational approximation that Eigen uses."""
    x = min(max(x, -LARGEST_TANH), LARGEST_TANH)
    s = x * x
    p = np.float32(-2.76076847742355e-16)
    p = p * s + np.float32(2.00018790482477e-13)
    p = p * s + np.float32(-8.60467152213735e-11)
    p = p * s + np.float32(5.12229709037114e-08)
    p = p * s + np.float32(1.48572235717979e-05)
    p = p * s + np.float32(6.37261928875436e-04)
    p = p * s + np.float32(4.89352455891786e-03)
    q = np.float32(1.19825839466702e-06)
    q = q * s + np.float32(1.18534705686654e-04)
    q = q * s + np.float32(2.26843463243900e-03)
    q = q * s + np.float32(4.89352518554385e-03)
    return x * p / q


@compiled
def activate(y: Floats, bias: Floats, relu: bool) -> None:
    """Add the bias to y (n, O) and apply the activation, in place."""
    rows, columns = y.shape
    for i in range(rows):
        if relu:
            for j in range(columns):
                y[i, j] = max(y[i, j] + bias[j], NONE)
        else:
            for j in range(columns):
                y[i, j] = bent(y[i, j] + bias[j])


@compiled
def through(slope: Floats, y: Floats, relu: bool) -> None:
    """Multiply ``slope`` (n, O), the derivative of a loss with respect to an activation's output y (n, O), by the
    activation's derivative, in place."""
    rows, columns = y.shape
    for i in range(rows):
        if relu:
            for j in range(columns):
                slope[i, j] = slope[i, j] if y[i, j] > NONE else NONE
        else:
            for j in range(columns):
                slope[i, j] *= ONE - y[i, j] * y[i, j]


@compiled
def forward(parameters: Floats, sizes: Ints, relu: bool, x: Floats, passed: Floats) -> Floats:
    """Return the outputs (n, O) of a network for inputs (n, I).

    Args:
        parameters: parameters of the network.
        sizes: sizes of the layers, from inputs to outputs.
        relu: whether the hidden units are rectified; otherwise tanh.
        x: inputs (n, I).
        passed: flat buffer that receives the outputs (n, units) of all layers but the input, one after the other.
    """
    rows, begin, at, last = len(x), 0, 0, sizes.size - 2
    for layer in range(last + 1):
        inputs, outputs = sizes[layer], sizes[layer + 1]
        middle, end = begin + inputs * outputs, begin + (inputs + 1) * outputs
        y = passed[at : at + rows * outputs].reshape((rows, outputs))
        np.dot(x, parameters[begin:middle].reshape((inputs, outputs)), y)
        if layer < last:
            activate(y, parameters[middle:end], relu)
        else:
            for i in range(rows):
                add(y[i], parameters[middle:end])
        begin, at, x = end, at + rows * outputs, y
    return x


@compiled
def turned(parameters: Floats, sizes: Ints) -> Floats:
    """Return the parameters (P,) with each layer's weights transposed, because BLAS multiplies by them faster."""
    found, begin = np.empty_like(parameters), 0
    for layer in range(sizes.size - 1):
        inputs, outputs = sizes[layer], sizes[layer + 1]
        weights = parameters[begin : begin + inputs * outputs].reshape((inputs, outputs))
        of_turned = found[begin : begin + inputs * outputs].reshape((outputs, inputs))
        for i in range(inputs):
            for j in range(outputs):
                of_turned[j, i] = weights[i, j]
        begin += (inputs + 1) * outputs
    return found


@compiled
def backward(
    transposed: Floats, gradient: Floats, sizes: Ints, relu: bool, x: Floats, passed: Floats, slope: Floats
) -> None:
    """Add the gradient of a loss to ``gradient`` (P,).

    Args:
        transposed: the parameters, with each layer's weights transposed.
        gradient: the gradient that is added to.
        sizes: sizes of the layers, from inputs to outputs.
        relu: whether the hidden units are rectified; otherwise tanh.
        x: inputs (n, I) of the last forward pass.
        passed: the buffer that the last forward pass filled.
        slope: the derivative of the loss with respect to the outputs of that pass (n, O).
    """
    rows, end, at = len(x), len(gradient), len(x) * sizes[1:].sum()
    spare = np.empty((2, rows * sizes.max()), dtype=np.float32)
    product = np.empty(len(gradient), dtype=np.float32)
    at -= rows * sizes[-1]
    for layer in range(sizes.size - 2, -1, -1):
        inputs, outputs = sizes[layer], sizes[layer + 1]
        middle, begin = end - outputs, end - (inputs + 1) * outputs
        at -= rows * inputs
        y = x if layer == 0 else passed[at : at + rows * inputs].reshape((rows, inputs))
        by_weights = product[: middle - begin]
        np.dot(y.T, slope, by_weights.reshape((inputs, outputs)))
        add(gradient[begin:middle], by_weights)
        for i in range(rows):
            add(gradient[middle:end], slope[i])
        if layer > 0:
            before = spare[layer % 2, : rows * inputs].reshape((rows, inputs))
            np.dot(slope, transposed[begin:middle].reshape((outputs, inputs)), before)
            through(before, y, relu)
            slope = before
        end = begin


@compiled
def add(total: Floats, more: Floats) -> None:
    for i in range(total.size):
        total[i] += more[i]


@inlined
def slope_of(log: np.float32, before: np.float32, advantage: np.float32, clip: np.float32) -> np.float32:
    """Return the derivative of a row's loss with respect to the log probability ``log`` of its action. ``before`` is
    the log probability when the action was taken. The derivative is 0 if the ratio of the two probabilities is beyond 1
    + ``clip`` and the ``advantage`` is positive, or below 1 - ``clip`` and the advantage is not."""
    ratio = np.float32(math.exp(log - before))
    free = ratio <= ONE + clip if advantage > NONE else ratio >= ONE - clip
    return -advantage * ratio if free else NONE


@compiled
def bounded(
    y: Floats,
    actions: Floats,
    logs: Floats,
    advantages: Floats,
    clip: np.float32,
    centre: Floats,
    reach: Floats,
    further: Floats,
    by_further: Floats,
) -> None:
    """Replace the outputs y (n, F) for continuous actions by the derivatives of the loss with respect to these outputs.
    Add its derivatives with respect to the logarithms of the standard deviations to ``by_further`` (F,).

    ``further`` (F,) are these logarithms. The other arguments are those of ``update``, for n rows.
    """
    inverse = np.empty_like(further)
    for j in range(further.size):
        inverse[j] = math.exp(-further[j])
    for i in range(len(y)):
        log = NONE
        for j in range(centre.size):
            y[i, j] = bent(y[i, j])
            z = (actions[i, j] - centre[j] - reach[j] * y[i, j]) * inverse[j]
            log += -HALF * z * z - further[j] - CONSTANT
        by = slope_of(log, logs[i], advantages[i], clip)
        for j in range(centre.size):
            z = (actions[i, j] - centre[j] - reach[j] * y[i, j]) * inverse[j]
            by_further[j] += by * (z * z - ONE)
            y[i, j] = by * z * inverse[j] * reach[j] * (ONE - y[i, j] * y[i, j])


@compiled
def log_softmax(scores: Floats) -> None:
    """Replace scores (O,) by log probabilities."""
    largest, total = scores[0], NONE
    for score in scores:
        largest = max(largest, score)
    for score in scores:
        total += math.exp(score - largest)
    shift = largest + np.float32(math.log(total))
    for i in range(scores.size):
        scores[i] -= shift


@compiled
def choices(y: Floats, actions: Floats, logs: Floats, advantages: Floats, clip: np.float32, counts: Ints) -> None:
    """Replace the outputs y (n, A) for discrete actions by the derivatives of the loss with respect to these
    outputs. The other arguments are those of ``update``, for n rows."""
    for i in range(len(y)):
        log, begin = NONE, 0
        for k in range(counts.size):
            log_softmax(y[i, begin : begin + counts[k]])
            log += y[i, begin + int(actions[i, k])]
            begin += counts[k]
        by, begin = slope_of(log, logs[i], advantages[i], clip), 0
        for k in range(counts.size):
            chosen = begin + int(actions[i, k])
            for j in range(begin, begin + counts[k]):
                y[i, j] = -by * np.float32(math.exp(y[i, j]))
            y[i, chosen] += by
            begin += counts[k]


@summing
def normalised(advantages: Floats) -> Floats:
    """Return advantages (B,) shifted to mean 0, scaled to standard deviation 1 and divided by B. A single advantage is
    unchanged."""
    size, mean, variance = advantages.size, 0.0, 0.0
    if size == 1:
        return advantages
    for one in advantages:
        mean += one / size
    for one in advantages:
        variance += (one - mean) ** 2 / (size - 1)
    found, scale = np.empty_like(advantages), 1 / (math.sqrt(variance) + 1e-8) / size
    for i in range(size):
        found[i] = np.float32((advantages[i] - mean) * scale)
    return found


@summing
def adam(
    parameters: Floats, gradient: Floats, first: Floats, second: Floats, updates: int, largest: float, rate: float
) -> None:
    """Take step number ``updates`` of Adam, with the gradient (P,) scaled to a norm of at most ``largest`` and the
    learning rate ``rate``. Parameters (P,) and moments ``first`` and ``second`` (P,) change in place."""
    squares = NONE
    for i in range(gradient.size):
        squares += gradient[i] * gradient[i]
    shorter = np.float32(min(1.0, largest / (math.sqrt(squares) + 1e-6)))
    root = np.float32((1 - SECOND_DECAY**updates) ** -0.5)
    step = np.float32(rate / (1 - FIRST_DECAY**updates))
    for i in range(gradient.size):
        g = gradient[i] * shorter
        first[i] = np.float32(FIRST_DECAY) * first[i] + np.float32(1 - FIRST_DECAY) * g
        second[i] = np.float32(SECOND_DECAY) * second[i] + np.float32(1 - SECOND_DECAY) * (g * g)
        parameters[i] -= step * first[i] / (np.sqrt(second[i]) * root + np.float32(EPSILON))


@entry(
    *(VECTOR,) * 3,
    *(SIZES,) * 4,
    types.boolean,
    *(VECTOR,) * 2,
    *(ROWS,) * 2,
    *(VECTOR,) * 3,
    types.int64,
    *(types.float64,) * 4,
)
def update(
    parameters: Floats,
    first: Floats,
    second: Floats,
    actor: Ints,
    critic: Ints,
    ends: Ints,
    counts: Ints,
    relu: bool,
    centre: Floats,
    reach: Floats,
    observations: Floats,
    actions: Floats,
    logs: Floats,
    advantages: Floats,
    returns: Floats,
    updates: int,
    clip_range: float,
    vf_coef: float,
    max_grad_norm: float,
    rate: float,
) -> None:
    """Take one step of Adam on the loss of a batch. Changes the parameters (P,) and both moments (P,) in place.

    Args:
        parameters: all parameters: the actor's, the critic's, and further ones (K,).
        first: Adam's first moments.
        second: Adam's second moments.
        actor: sizes of the actor's layers, from inputs to outputs.
        critic: sizes of the critic's layers, from inputs to outputs.
        ends: two indices into the parameters: the ends of the actor's and of the critic's.
        counts: numbers of choices of each entry of a discrete action; empty for continuous actions.
        relu: whether the hidden layers use ReLU; otherwise tanh.
        centre, reach: middle and half width of the bounds (F,) of continuous actions.
        observations: standardised observations (B, D).
        actions: actions (B, F).
        logs: log probabilities (B,) of the actions when they were taken.
        advantages: advantages (B,).
        returns: targets of the critic (B,).
        updates: number of this step of Adam, from 1.
        clip_range, vf_coef, max_grad_norm: as in Stable-Baselines3's PPO.
        rate: learning rate.
    """
    gradient, clip = np.zeros_like(parameters), np.float32(clip_range)
    ours, theirs = slice(0, ends[0]), slice(ends[0], ends[1])
    actor_turned, critic_turned = turned(parameters[ours], actor), turned(parameters[theirs], critic)
    weighted, by_error = normalised(advantages), np.float32(2 * vf_coef / len(returns))
    passed = np.empty(BLOCK * max(actor[1:].sum(), critic[1:].sum()), dtype=np.float32)
    for begin in range(0, len(returns), BLOCK):
        at = slice(begin, min(begin + BLOCK, len(returns)))
        x, logs_at, weighted_at = observations[at], logs[at], weighted[at]
        y = forward(parameters[ours], actor, relu, x, passed)
        if counts.size > 0:
            choices(y, actions[at], logs_at, weighted_at, clip, counts)
        else:
            further, by_further = parameters[ends[1] :], gradient[ends[1] :]
            bounded(y, actions[at], logs_at, weighted_at, clip, centre, reach, further, by_further)
        backward(actor_turned, gradient[ours], actor, relu, x, passed, y)
        y = forward(parameters[theirs], critic, relu, x, passed)
        for i in range(len(x)):
            y[i, 0] = (y[i, 0] - returns[begin + i]) * by_error
        backward(critic_turned, gradient[theirs], critic, relu, x, passed, y)
    adam(parameters, gradient, first, second, updates, max_grad_norm, rate)
