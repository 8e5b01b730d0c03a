"""Model family of Gaussian processes: structure chosen by evidence, every posterior in closed form."""

from surrogym_server.models.gaussian_process.family import GaussianProcesses

__all__ = ["GaussianProcesses"]
