"""Conversion of Gaussian process models to a header and named arrays, and back."""
