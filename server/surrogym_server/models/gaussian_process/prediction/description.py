"""Description of one output of a model, for people."""

from __future__ import annotations

import math
from typing import Any

from surrogym_server.models.gaussian_process.prediction.output_model import OutputModel


def describe(output: OutputModel) -> dict[str, Any]:
    """Structure and hyperparameters of an output, as JSON."""
    described: dict[str, Any] = {
        "name": output.name,
        "inputs": str(output.feature_map),
        "kernel": "constant",
        "centre": output.centre,
        "scale": output.scale,
        "left_out": output.left_out,
        "scores": dict(output.scores),
    }
    if output.warp is not None:
        described["learned"] = str(output.warp)
    if output.posterior is not None:
        hyper = output.posterior.hyper
        described |= {
            "kernel": hyper.kernel,
            "points": len(output.posterior.y),
            "lengthscale": hyper.lengthscale.tolist(),
            "signal_variance": hyper.signal_variance,
            "linear_variance": hyper.linear_variance,
            "quadratic_variance": hyper.quadratic_variance,
            "noise_variance": hyper.noise_variance,
            "jitter": output.posterior.jitter,
        }
        if (sparse := output.posterior.sparse) is not None:
            prior = hyper.signal_variance + hyper.linear_variance
            described |= {
                "points": sparse.points,
                "inducing_points": len(output.posterior.y),
                "unexplained_deviation": output.scale * math.sqrt(prior) * sparse.unexplained,
            }
    return described


def structure(output: OutputModel) -> str:
    """Kernel and inputs of an output, in a few words."""
    if output.posterior is None:
        return "constant"
    learned = "" if output.warp is None else f"{output.warp}: "
    return f"{learned}{output.posterior.hyper.kernel} on {output.feature_map}"
