"""Prediction with a fitted model of Gaussian processes."""
