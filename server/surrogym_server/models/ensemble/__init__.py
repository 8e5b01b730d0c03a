"""Model family of ensembles of neural networks: the disagreement of the networks is the model's uncertainty."""

from surrogym_server.models.ensemble.family import NetworkEnsembles

__all__ = ["NetworkEnsembles"]
