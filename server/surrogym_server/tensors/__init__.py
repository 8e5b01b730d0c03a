"""Tensors in general: their device, caching, blocks of rows, and order in memory."""

from surrogym_server.tensors.blocks import in_blocks
from surrogym_server.tensors.cached import cached
from surrogym_server.tensors.in_rows import in_rows
from surrogym_server.tensors.to_device import CPU, to_device

__all__ = ["CPU", "cached", "in_blocks", "in_rows", "to_device"]
