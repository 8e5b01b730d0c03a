"""The family of sparse Gaussian processes: for thousands of samples, through a few hundred inducing points."""

from surrogym_server.models.sparse_gaussian_process.family import SparseGaussianProcesses

__all__ = ["SparseGaussianProcesses"]
