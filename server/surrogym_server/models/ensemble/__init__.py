"""The family of network ensembles, whose uncertainty is the disagreement of networks trained on the same samples."""

from surrogym_server.models.ensemble.family import NetworkEnsembles

__all__ = ["NetworkEnsembles"]
