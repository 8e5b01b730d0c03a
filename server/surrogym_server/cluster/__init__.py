"""Sessions in a Ray cluster: a fixed pool of processes, each with a ``LocalEngine``, behind ``SessionEngine``."""
