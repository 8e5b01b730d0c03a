"""Names that earlier versions knew, each with one sentence about what takes its place.

Specifications, files and scripts keep such names. Code that refuses an unknown name asks here, so its message also
says what to do instead.
"""

from __future__ import annotations

from collections.abc import Mapping

PLANNED = "leave it out for the default, 'integrated_variance'"
TRUST_POLICY = "use --trust-policy, which reads pickled objects"
REMOVED: Mapping[str, Mapping[str, str]] = {
    "acquisition": {
        "barl": PLANNED,
        "tip": PLANNED,
        "opax": PLANNED,
    },
    "arm": {
        "barl": "use 'no_loop'",
    },
    "option of audit": {"--trust": TRUST_POLICY},
    "option of evaluate": {"--trust": TRUST_POLICY},
    "option of export-policy": {"--trust": TRUST_POLICY},
    "option of register": {"--teleport": "use --access any", "--no-teleport": "use --access reset"},
    "model": {
        "bayesian_last_layer": "use 'gaussian_process' for few real steps, 'ensemble' for contacts and many steps",
        "selected": "name the family itself, such as 'gaussian_process' or 'ensemble'",
    },
}


def instead_of(kind: str, name: str) -> str | None:
    """Return what takes the place of a removed name of a kind, such as "model"; None if it was never known."""
    matches = (instead for removed, instead in REMOVED.get(kind, {}).items() if removed.casefold() == name.casefold())
    return next(matches, None)


def remark(kind: str, name: str) -> str:
    """Return the end of a message "expected ..., got NAME": "; NAME was removed: ...", or nothing."""
    instead = instead_of(kind, name)
    return "" if instead is None else f"; {name!r} was removed: {instead}"
