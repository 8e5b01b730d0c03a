"""Implementations of peers, each after its publication."""
