"""What compiled steps are made of: tables that they read, and elementary functions.

Files of this room, and those in folders or files named ``compiled`` in other rooms, import numba. Everything else
imports them lazily, where ``surrogym_shared.compiled.available`` says so: numba is not there for every platform.
"""
