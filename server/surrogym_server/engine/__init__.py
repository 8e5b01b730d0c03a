"""Engines that run sessions (virtual environments of clients), and child processes in which models are fitted."""
