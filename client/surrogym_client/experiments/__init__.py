"""Whole runs from cold: what ``surrogym demo`` and ``surrogym reproduce`` share is here, the rest in a room of each."""
