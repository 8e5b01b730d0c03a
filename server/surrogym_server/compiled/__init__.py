"""What compiled steps are made of: functions compiled by numba, tables that they read, and elementary functions.

Files of this room, and those in folders or files named ``compiled`` in other rooms, import numba. Everything else
imports them lazily, where ``available`` says so: numba is not there for every platform.
"""

from __future__ import annotations

import os
from functools import cache
from importlib.util import find_spec

SWITCH = "SURROGYM_COMPILED"  # environment variable: 0 turns compiled steps off


@cache
def available() -> bool:
    """Whether steps can be compiled in this process. Numba is not imported to find out."""
    wanted = os.environ.get(SWITCH, "1") != "0" and os.environ.get("NUMBA_DISABLE_JIT", "0") == "0"
    return wanted and find_spec("numba") is not None
