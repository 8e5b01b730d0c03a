"""Proximal policy optimisation in compiled code, with derivatives written by hand. It does not need torch."""
