"""Call a function as soon as another module is imported."""

from __future__ import annotations

import sys
from importlib import import_module
from importlib.machinery import PathFinder
from typing import TYPE_CHECKING, cast

if TYPE_CHECKING:  # importlib.abc takes as long to load as all commands together
    from collections.abc import Sequence
    from importlib.abc import Loader
    from importlib.machinery import ModuleSpec
    from types import ModuleType


def after_import(module: str, function: str) -> None:
    """Call ``function``, given as ``package.module:name``, after ``module`` is imported; at once if it is already."""
    if module in sys.modules:
        _call(function)
    else:
        sys.meta_path.insert(0, _Finder(module, function))


class _Finder:
    """Import hook for one module: finds it as Python does, and makes its loader call a function after the import."""

    def __init__(self, module: str, function: str) -> None:
        self._module, self._function = module, function

    def find_spec(
        self,
        fullname: str,
        path: Sequence[str] | None,
        target: ModuleType | None = None,
    ) -> ModuleSpec | None:
        if fullname != self._module:
            return None
        sys.meta_path.remove(self)
        spec = PathFinder.find_spec(fullname, path, target)
        if spec is not None and spec.loader is not None:
            # The cast is safe, because _Loader has the two methods that Python calls.
            spec.loader = cast("Loader", _Loader(spec.loader, self._function))
        return spec


class _Loader:
    """Loader that loads a module by another loader, and then calls a function."""

    def __init__(self, loader: Loader, function: str) -> None:
        self._loader, self._function = loader, function

    def create_module(self, spec: ModuleSpec) -> ModuleType | None:
        return self._loader.create_module(spec)

    def exec_module(self, module: ModuleType) -> None:
        assert module.__spec__ is not None
        module.__spec__.loader = module.__loader__ = self._loader
        self._loader.exec_module(module)
        _call(self._function)


def _call(function: str) -> None:
    module, _, name = function.partition(":")
    getattr(import_module(module), name)()
