"""Deployment: a policy as a controller that runs without Python, for a microcontroller, a PLC or another simulator."""
