"""Conversion of Gaussian process models to data and back."""
