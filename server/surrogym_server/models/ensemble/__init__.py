"""The family of network ensembles: what is not known is where networks that saw the same samples disagree."""

from surrogym_server.models.ensemble.family import NetworkEnsembles

__all__ = ["NetworkEnsembles"]
