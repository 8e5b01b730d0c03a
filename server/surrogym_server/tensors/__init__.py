"""Tensors, whatever they hold: on a device, cached outside inference mode, and rows in blocks."""

from surrogym_server.tensors.blocks import in_blocks
from surrogym_server.tensors.cached import cached
from surrogym_server.tensors.to_device import CPU, to_device

__all__ = ["CPU", "cached", "in_blocks", "to_device"]
