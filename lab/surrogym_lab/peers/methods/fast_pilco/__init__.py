"""Beliefs of PILCO in compiled code, with gradients written out. ``moments`` and ``belief`` are the same in torch, and
the reference."""
