"""Moments of Gaussian beliefs through Gaussian processes, sines and cosines, batched over K beliefs (torch).

Shapes: K beliefs, I inputs, E outputs, P pairs of outputs, n samples. M. P. Deisenroth, C. E. Rasmussen, "PILCO", ICML
2011; M. P. Deisenroth, "Efficient Reinforcement Learning using Gaussian Processes" (2010), section 2.3 and appendix A.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from surrogym_lab.peers.methods.gaussian_process import Processes


@dataclass(frozen=True)
class Moments:
    """Mean (K, E) and covariance (K, E, E) of outputs, and ``gain`` (K, I, E): the inverse covariance of the inputs
    times the covariance of inputs and outputs."""

    mean: Tensor
    covariance: Tensor
    gain: Tensor


def through_processes(model: Processes, mean: Tensor, covariance: Tensor, *, certain: bool = False) -> Moments:
    """Moments of the outputs of processes for inputs with mean (K, I) and covariance (K, I, I).

    Args:
        model: the processes.
        mean, covariance: of the inputs.
        certain: take the processes' means for exact functions, as for PILCO's policy.
    """
    means, gain = _mean_and_gain(model, mean, covariance)
    second = _second_moments(model, mean, covariance, certain=certain)
    return Moments(means, second - means[:, :, None] * means[:, None], gain)


def _mean_and_gain(model: Processes, mean: Tensor, covariance: Tensor) -> tuple[Tensor, Tensor]:
    """Means (K, E), equations 14 and 15, and gains (K, I, E), equation 16 with the covariance divided off."""
    nu = model.x - mean[:, None]  # (K, n, I)
    scale = 1 / model.lengthscale  # (E, I), Lambda^(-1/2)
    eye = torch.eye(mean.shape[-1], dtype=mean.dtype)
    b = scale[:, :, None] * covariance[:, None] * scale[:, None] + eye  # (K, E, I, I)
    scaled = nu[:, None] * scale[:, None]  # (K, E, n, I)
    t = torch.linalg.solve(b, scaled.mT).mT  # (K, E, n, I)
    q = torch.exp(-(scaled * t).sum(-1) / 2) * model.weights  # beta_i q_i without its factor
    c = model.signal**2 / torch.linalg.det(b).sqrt()  # (K, E)
    gain = (q[..., None, :] @ (t * scale[:, None]))[..., 0, :] * c[..., None]  # (K, E, I)
    return c * q.sum(-1), gain.mT


def _second_moments(model: Processes, mean: Tensor, covariance: Tensor, *, certain: bool) -> Tensor:
    """Means (K, E, E) of products of two outputs, equations 18, 22 and 23."""
    outputs = len(model.signal)
    first, second = torch.triu_indices(outputs, outputs)  # (P,) each
    precision = 1 / model.lengthscale**2  # (E, I)
    nu = model.x - mean[:, None]  # (K, n, I)
    eye = torch.eye(mean.shape[-1], dtype=mean.dtype)
    r = covariance[:, None] * (precision[first] + precision[second])[:, None] + eye  # (K, P, I, I)
    half = torch.linalg.solve(r, covariance[:, None].expand_as(r)) / 2  # R^-1 Sigma / 2
    log_k = 2 * model.signal.log()[:, None] - (nu[:, None] ** 2 * precision[:, None]).sum(-1) / 2  # (K, E, n)
    a, b = nu[:, None] * precision[first][:, None], nu[:, None] * precision[second][:, None]  # (K, P, n, I)
    left, right = a @ half, b @ half
    from_a, from_b = log_k[:, first] + (left * a).sum(-1), log_k[:, second] + (right * b).sum(-1)
    products = torch.exp(from_a[..., None] + from_b[..., None, :] + 2 * left @ b.mT)  # (K, P, n, n)
    root = torch.linalg.det(r).sqrt()
    moment = (model.weights[first][:, None] @ products @ model.weights[second][..., None])[..., 0, 0] / root
    full = torch.zeros(len(mean), outputs, outputs, dtype=mean.dtype)
    full[:, first, second] = moment
    full[:, second, first] = moment
    if certain:
        return full
    own = first == second
    traces = (products[:, own] * model.inverse).sum((-2, -1)) / root[:, own]  # (K, E)
    return full + torch.diag_embed(model.signal**2 - traces)


def through_angles(mean: Tensor, covariance: Tensor) -> Moments:
    """Moments of the sines, then the cosines of angles with mean (K, G) and covariance (K, G, G)."""
    variance = covariance.diagonal(dim1=-2, dim2=-1)
    shrink = torch.exp(-variance / 2)
    sin, cos = shrink * mean.sin(), shrink * mean.cos()
    total = (variance[:, :, None] + variance[:, None]) / 2
    less, more = torch.exp(covariance - total), torch.exp(-covariance - total)
    minus, plus = mean[:, :, None] - mean[:, None], mean[:, :, None] + mean[:, None]
    sin_sin = (less * minus.cos() - more * plus.cos()) / 2
    cos_cos = (less * minus.cos() + more * plus.cos()) / 2
    sin_cos = (less * minus.sin() + more * plus.sin()) / 2
    means = torch.cat([sin, cos], -1)
    second = torch.cat([torch.cat([sin_sin, sin_cos], -1), torch.cat([sin_cos.mT, cos_cos], -1)], -2)
    gain = torch.cat([torch.diag_embed(cos), torch.diag_embed(-sin)], -1)  # Stein's lemma
    return Moments(means, second - means[:, :, None] * means[:, None], gain)


def squashed(mean: Tensor, covariance: Tensor) -> Moments:
    """Moments of 9/8 sin(v) + 1/8 sin(3 v), which is in [-1, 1], for v with mean (K, F) and covariance (K, F, F)."""
    size = mean.shape[-1]
    eye = torch.eye(size, dtype=mean.dtype)
    triple = torch.cat([eye, 3 * eye])  # (2 F, F)
    mixed = torch.cat([9 / 8 * eye, 1 / 8 * eye], 1)  # (F, 2 F)
    of_sines = through_angles(mean @ triple.T, triple @ covariance @ triple.T)
    taken = slice(0, 2 * size)
    return Moments(
        of_sines.mean[:, taken] @ mixed.T,
        mixed @ of_sines.covariance[:, taken, taken] @ mixed.T,
        triple.T @ of_sines.gain[:, :, taken] @ mixed.T,
    )


def saturating_cost(mean: Tensor, covariance: Tensor, goal: Tensor, width: float) -> Tensor:
    """Expected costs (K,) 1 - exp(-d^2 / (2 width^2)) of a tip with mean (K, T) and covariance (K, T, T).

    d is its distance to the goal (T,) (equation 25; the mean is derived in the thesis).
    """
    away = mean - goal
    s = covariance / width**2 + torch.eye(mean.shape[-1], dtype=mean.dtype)
    distance = (away * torch.linalg.solve(s, away)).sum(-1) / width**2
    cost: Tensor = 1 - torch.exp(-distance / 2) / torch.linalg.det(s).sqrt()
    return cost
