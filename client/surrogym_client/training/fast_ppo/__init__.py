"""Proximal policy optimisation in NumPy, with gradients written out; needs no torch."""
