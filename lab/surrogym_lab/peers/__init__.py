"""Other methods on our tasks: a port, small implementations of peers, and their learning curves.

Only ``python -m surrogym_lab peers`` imports this folder (lab/records/decisions/0069).
"""
