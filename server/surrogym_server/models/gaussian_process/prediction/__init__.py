"""Prediction with a fitted model."""
