"""Engines that run sessions, and the processes in which fits run."""
