"""Whole runs from the beginning: the shared parts of ``surrogym demo`` and ``surrogym reproduce``, and a room
for each."""
