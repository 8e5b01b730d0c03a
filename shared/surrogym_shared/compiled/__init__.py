"""Functions compiled by numba, kept on disk for the next process.

``jit`` imports numba, and so do files and folders named ``compiled`` of server and client. Other code imports these
only when it needs them and ``available`` is True, because numba does not exist for every platform.
"""

from __future__ import annotations

import os
from functools import cache
from importlib.util import find_spec

SWITCH = "SURROGYM_COMPILED"  # environment variable: 0 turns compiled code off


@cache
def available() -> bool:
    """Whether this process can compile code. This does not import numba."""
    enabled = os.environ.get(SWITCH, "1") != "0" and os.environ.get("NUMBA_DISABLE_JIT", "0") == "0"
    return enabled and find_spec("numba") is not None
