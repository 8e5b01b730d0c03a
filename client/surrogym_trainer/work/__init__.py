"""The trainer worker: it runs trainings and evaluations that people ask the server for."""
