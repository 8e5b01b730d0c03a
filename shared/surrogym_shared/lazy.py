"""Helper of packages that import a module only when one of its names is first used."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any


def on_first_use(package: str, names: Mapping[str, str]) -> tuple[Callable[[str], Any], list[str]]:
    """Return ``__getattr__`` and ``__all__`` of a package (PEP 562), which import a module when a name is first used.

    Args:
        package: ``__name__`` of the package.
        names: the names that each module of the package offers, separated by spaces.

    Examples:
        >>> __getattr__, __all__ = on_first_use(__name__, {"connection": "Retries Timeouts"})
    """
    homes = {name: module for module, offered in names.items() for name in offered.split()}

    def __getattr__(name: str) -> Any:
        if name not in homes:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        value = getattr(import_module(f"{package}.{homes[name]}"), name)
        setattr(sys.modules[package], name, value)
        return value

    return __getattr__, sorted(homes)
