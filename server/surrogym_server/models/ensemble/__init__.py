"""Model family of network ensembles: the disagreement of networks trained on the same samples is the uncertainty."""

from surrogym_server.models.ensemble.family import NetworkEnsembles

__all__ = ["NetworkEnsembles"]
