"""Environments of Gymnasium whose steps a surrogate computes: one lane or many, over a server or from a file."""

from surrogym_client.environments.env import RemoteEnv
from surrogym_client.environments.file_factories import open_file
from surrogym_client.environments.vector import RemoteVectorEnv

__all__ = ["RemoteEnv", "RemoteVectorEnv", "open_file"]
