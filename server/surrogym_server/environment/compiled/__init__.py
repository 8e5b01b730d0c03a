"""The environment in compiled code: terms, conditions, features, declared rewards and rules of a step.

Each file has a function that writes its data into tables, and compiled functions that read these tables. Arrays have
the shape (entries, B), one column for each lane of a block, so that a loop over lanes becomes vector instructions. The
classes in ``environment`` are the reference.
"""
