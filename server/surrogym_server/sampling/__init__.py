"""The design: it chooses the real steps to request (queries), and decides when the model is good enough."""
