"""Comparison of a stream of real steps with a model, to detect that the plant has changed."""
