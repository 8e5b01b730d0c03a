"""Conversion of a model to bytes and back."""
