"""Names of removed models, options and the like, each with its replacement.

Old specifications, files and scripts may have such names. The error about an unknown name then says what replaces it.
"""

from __future__ import annotations

from collections.abc import Mapping

PLANNED = "leave it out for the default, 'integrated_variance'"
TRUST_POLICY = "use --trust-policy, which reads pickled objects"
CAUTION = "use {}penalty, or {}trust to end episodes"
PROPAGATION = "leave it out, each particle moves by a sample of its own"
WEIGHTING = "leave it out, the particles' rewards are weighted by inverse variance"
REMOVED: Mapping[str, Mapping[str, str]] = {
    "acquisition": {
        "barl": PLANNED,
        "tip": PLANNED,
        "opax": PLANNED,
    },
    "algorithm": {"gradient": "use 'FASTPPO', which needs no gradients of the model"},
    "arm": {
        "barl": "use 'no_loop'",
    },
    "command": {
        "optimise": "use surrogym train",
        "reproduce": "use python -m surrogym_lab, in a clone",
    },
    "option of audit": {"--trust": TRUST_POLICY},
    "option of demo": {"--arm": "use python -m surrogym_lab demo, in a clone"},
    "option of evaluate": {"--trust": TRUST_POLICY},
    "option of export-policy": {"--trust": TRUST_POLICY},
    "option of train": {
        "--caution": CAUTION.format("--", "--"),
        "--propagation": PROPAGATION,
        "--weighting": WEIGHTING,
    },
    "option of serve": {"--synchronous": "leave it out, each commit waits for the disk"},
    "option of register": {"--teleport": "use --access any", "--no-teleport": "use --access reset"},
    "model": {
        "bayesian_last_layer": "use 'gaussian_process' for few real steps, 'ensemble' for contacts and many steps",
        "selected": "name the family itself, such as 'gaussian_process' or 'ensemble'",
    },
    "session option": {
        "caution": CAUTION.format("", ""),
        "propagation": PROPAGATION,
        "weighting": WEIGHTING,
    },
}


def instead_of(kind: str, name: str) -> str | None:
    """Return what replaces a removed name of a kind such as "model"; None if no such name was removed."""
    matches = (instead for removed, instead in REMOVED.get(kind, {}).items() if removed.casefold() == name.casefold())
    return next(matches, None)


def remark(kind: str, name: str) -> str:
    """Return the end of an error about an unknown name: "; NAME was removed: ...", or "" if it was not removed."""
    instead = instead_of(kind, name)
    return "" if instead is None else f"; {name!r} was removed: {instead}"
