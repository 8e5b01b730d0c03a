"""Model family of Gaussian processes, whose inputs and kernels are chosen by evidence."""

from surrogym_server.models.gaussian_process.family import GaussianProcesses

__all__ = ["GaussianProcesses"]
