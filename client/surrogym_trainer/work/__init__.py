"""The trainer worker, which runs the trainings and evaluations that people request from the server."""
