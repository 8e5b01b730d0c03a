"""Prediction of steps by compiled code, with the results of ``prediction.predictor`` and ``prediction.regions``."""
