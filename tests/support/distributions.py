"""Which installed distributions a requirement leads to."""

from __future__ import annotations

from importlib.metadata import distribution, packages_distributions

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name


def needed(requirement: str, found: dict[str, set[str]]) -> dict[str, set[str]]:
    """All installed distributions that a requirement leads to, with the extras asked of each."""
    asked = Requirement(requirement)
    name, extras = canonicalize_name(asked.name), set(asked.extras)
    if name in found and extras <= found[name]:
        return found
    found.setdefault(name, set()).update(extras)
    for line in distribution(name).requires or ():
        marker = Requirement(line).marker
        if marker is None or any(marker.evaluate({"extra": extra}) for extra in {"", *extras}):
            needed(line, found)
    return found


def absent(requirement: str) -> list[str]:
    """The modules installed here that a requirement does not lead to."""
    brought = needed(requirement, {}).keys()
    return [
        module
        for module, names in packages_distributions().items()
        if not brought & {canonicalize_name(name) for name in names}
    ]
