"""Description of one output of a model (its inputs, kernel and hyperparameters), for display."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.environment.features import FeatureMap, feature_names
from surrogym_server.models.gaussian_process.prediction.output_model import OutputModel


def describe(definition: EnvironmentDefinition, output: OutputModel) -> dict[str, Any]:
    """Return the structure and hyperparameters of an output, as values for JSON. In the result, the lists ``features``
    and ``lengthscale`` have the same order."""
    described: dict[str, Any] = {
        "name": output.name,
        "inputs": str(output.feature_map),
        "kernel": "constant",
        "centre": output.centre,
        "scale": output.scale,
        "left_out": output.left_out,
        "scores": dict(output.scores),
    }
    if output.size_with_prior is not None:
        described["beside"] = "prior"
    if output.warp is not None:
        described["learned"] = str(output.warp)
    if output.posterior is not None:
        hyper = output.posterior.hyper
        described |= {
            "kernel": hyper.kernel,
            **_inputs(definition, output.feature_map),
            "points": len(output.posterior.y),
            "lengthscale": hyper.lengthscale.tolist(),
            "signal_variance": hyper.signal_variance,
            "linear_variance": hyper.linear_variance,
            "quadratic_variance": hyper.quadratic_variance,
            "noise_variance": hyper.noise_variance,
            "jitter": output.posterior.jitter,
            "shares_samples_with": list(output.shared),
        }
        if (sparse := output.posterior.sparse) is not None:
            prior = hyper.signal_variance + hyper.linear_variance
            described |= {
                "points": sparse.points,
                "inducing_points": len(output.posterior.y),
                "unexplained_deviation": output.scale * math.sqrt(prior) * sparse.unexplained,
            }
    return described


def _inputs(definition: EnvironmentDefinition, feature_map: FeatureMap) -> dict[str, Any]:
    """Return, for display, the names of the features that an output reads, the names of those that it ignores, and the
    rates (see ``gp.growth``) other than 0."""
    names = feature_names(definition, feature_map)
    every = feature_names(definition, replace(feature_map, rates=(), dropped=()))
    rates = {name: rate for name, rate in zip(names, feature_map.rates, strict=False) if rate}
    return {"features": names, "features_left_out": [every[place] for place in feature_map.dropped], "rates": rates}


def structure(output: OutputModel) -> str:
    """Return the kernel and the inputs of an output, in a few words."""
    prefix = "" if output.size_with_prior is None else "prior + "
    if output.posterior is None:
        return f"{prefix}constant"
    prefix += "" if output.warp is None else f"{output.warp}: "
    shared = f", with samples of {', '.join(output.shared)}" if output.shared else ""
    return f"{prefix}{output.posterior.hyper.kernel} on {output.feature_map}{shared}"
