"""A step of the model in compiled code; ``prediction.predictor`` and ``prediction.regions`` are the reference."""
