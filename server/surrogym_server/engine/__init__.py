"""Live sessions, and the processes in which fits run."""
