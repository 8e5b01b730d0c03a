"""The same environment in compiled code: terms, conditions, features, declared rewards and rules of a step.

Each file has a function that puts what it needs into tables, and compiled functions that read it there. Quantities lie
as (entries, B), one column a lane of a block: a loop over lanes becomes vector instructions. The classes in
``environment`` are the reference.
"""
