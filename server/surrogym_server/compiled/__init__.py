"""Parts of compiled steps: the tables that they read, and elementary functions.

Files of this room, and those in folders or files named ``compiled`` in other rooms, import numba. All other files
import them lazily, if ``surrogym_shared.compiled.available`` allows it, because numba does not exist for every
platform.
"""
