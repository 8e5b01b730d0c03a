"""Proximal policy optimisation in NumPy, with derivatives written by hand. It does not need torch."""
