"""The environment in compiled code: terms, conditions, features, declared rewards and rules of a step.

Each file has functions that write data into tables (see ``compiled.tables``), and compiled functions that read these
tables. Arrays have the shape (entries, B) for B lanes (parallel environments), so that a loop over lanes becomes vector
instructions. The reference implementations, in torch, are the classes in ``environment``.
"""
