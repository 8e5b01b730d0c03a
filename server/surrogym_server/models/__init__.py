"""Families of dynamics models."""
