"""Import of a user's class or function by its name ``package.module:factory``."""

from __future__ import annotations

import importlib
import os
import sys
from typing import Any

from surrogym_sampler.original.errors import UnknownEnvironment, sentence


def load_factory(name: str) -> Any:
    """Import the factory ``package.module:attribute``. The working directory is searched too.

    Raises:
        UnknownEnvironment: the module can't be imported, or has no such callable.
    """
    module_name, _, attribute = name.partition(":")
    if os.getcwd() not in sys.path:
        sys.path.insert(0, os.getcwd())
    try:
        factory = getattr(importlib.import_module(module_name), attribute)
    except (ImportError, AttributeError, ValueError) as error:
        module = module_name.removesuffix(".py")
        meant = f"; did you mean {module}:{attribute}?" if module != module_name else ""
        raise UnknownEnvironment(f"expected package.module:factory, got {name!r}: {error}{meant}") from error
    except SyntaxError as error:
        raise UnknownEnvironment(
            f"{module_name} can't be imported: {type(error).__name__}: {error}; correct it"
        ) from error
    except SystemExit as error:
        raise UnknownEnvironment(
            f"{module_name} called sys.exit while it was imported: {sentence(error)}; remove the call"
        ) from error
    if not callable(factory):
        raise UnknownEnvironment(
            f"expected {name!r} to be callable, got a {type(factory).__name__}: name a class or function"
        )
    return factory
