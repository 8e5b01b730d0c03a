"""Proximal policy optimisation in NumPy, with gradients written out. It needs no torch."""
