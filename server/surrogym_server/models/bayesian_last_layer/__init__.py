"""The family of networks whose last layers are exact Bayesian linear regressions."""

from surrogym_server.models.bayesian_last_layer.family import BayesianLastLayers

__all__ = ["BayesianLastLayers"]
