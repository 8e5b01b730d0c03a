"""Registries of classes that a specification chooses by name and settings. Installed packages may add classes."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, TypeVar, get_type_hints

from surrogym_server.errors import InvalidSpec, SurrogymError
from surrogym_shared import plugins

T = TypeVar("T")
# For each type of a plug-in's setting: what error messages call it, and the types of values that are accepted for it.
TYPES: dict[Any, tuple[str, tuple[type, ...]]] = {
    float: ("a number", (int, float)),
    int: ("a whole number", (int,)),
    bool: ("true or false", (bool,)),
    str: ("a text", (str,)),
}


@dataclass(frozen=True)
class Choice:
    """Choice of a class in a registry, such as a model family: its name, and the settings with which to make it."""

    name: str
    settings: tuple[tuple[str, float | bool | str], ...] = ()


class Registry(plugins.Registry[T]):
    """Registry of classes of one kind, such as model families, by name. It makes instances of them with settings."""

    def lack(self, choice: Choice) -> str | None:
        """Describe what must be installed or repaired before an instance of a stored choice can be made. Return None if
        the instance can be made now.

        The text is a noun phrase that can follow "it needs".
        """
        what = f"the {self.noun} {choice.name!r}"
        try:
            self.name_of(choice.name)
        except plugins.UnknownMember:
            why = self.why_broken(choice.name)
            if why is None and (instead := self.instead_of(choice.name)) is not None:
                return f"{what}, which was removed: {instead}"
            if why is None:
                return f"{what}, which no installed package provides: install its package on the server and restart"
            return f"{what}, which can't be loaded: repair its package on the server and restart ({why})"
        try:
            self.make(choice)
        except InvalidSpec as error:
            return f"another version of {what}: install it on the server and restart ({error})"
        return None

    def get(self, name: str) -> type[T]:
        """Return the class that is registered as ``name``.

        Raises:
            InvalidSpec: no class has this name, or its package is broken; the message lists the known names.
        """
        try:
            return super().get(name)
        except plugins.UnknownMember as error:
            raise InvalidSpec(str(error)) from None

    def make(self, choice: Choice) -> T:
        """Make an instance of the chosen class, a frozen dataclass whose fields are the settings.

        Raises:
            InvalidSpec: the name or a setting is unknown, or a value is invalid.
        """
        kind, settings = self.get(choice.name), dict(choice.settings)
        with guarded(f"{self.kind} {choice.name}", InvalidSpec):
            _check_settings(kind, settings)
            return kind(**settings)


@contextmanager
def guarded(what: str, failure: type[SurrogymError], *, interrupts: bool = False) -> Iterator[None]:
    """Return a context for calls of another package's code: errors of this code become a ``failure``.

    The message of the failure begins with ``what``. It includes the type of the error, except that of a ``ValueError``
    if ``failure`` is ``InvalidSpec``, because plug-ins raise ``ValueError`` on purpose to refuse a specification.

    A ``SurrogymError`` passes unchanged. ``KeyboardInterrupt`` passes unless ``interrupts`` is True. A server sets
    ``interrupts`` in requests, where a ``KeyboardInterrupt`` can't come from Ctrl-C.
    """
    try:
        yield
    except SurrogymError:
        raise
    except BaseException as error:
        if isinstance(error, KeyboardInterrupt) and not interrupts:
            raise
        raise failed(what, failure, error) from error


def failed(what: str, failure: type[SurrogymError], error: BaseException) -> SurrogymError:
    """Return a ``failure`` that describes another package's ``error``; its message begins with ``what``."""
    refused = isinstance(error, ValueError) and failure is InvalidSpec
    return failure(f"{what}: {plugins.one_line(error, typed=not refused)}")


def in_one_line(error: BaseException) -> str:
    """Describe an error in one line: its message, preceded by its type unless it is a ``SurrogymError``."""
    return plugins.one_line(error, typed=not isinstance(error, SurrogymError))


def _check_settings(kind: type, settings: dict[str, float | bool | str]) -> None:
    """Check settings against the fields of a class. Raises ``ValueError`` if a setting is unknown, is missing, or has a
    wrong type."""
    fields = [field for field in dataclasses.fields(kind) if field.init] if dataclasses.is_dataclass(kind) else []
    names = ", ".join(field.name for field in fields)
    if unknown := sorted(set(settings) - {field.name for field in fields}):
        raise ValueError(f"expected {f'a setting out of {names}' if names else 'no settings'}, got {unknown[0]!r}")
    for field in fields:
        needed = field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING
        if needed and field.name not in settings:
            raise ValueError(
                f"expected a value for {field.name}, which has no default, got none; all settings are {names}"
            )
    types = _types(kind)
    for name, given in settings.items():
        expected = TYPES.get(types.get(name))
        if expected is not None and type(given) not in expected[1]:
            raise ValueError(f"expected {name} to be {expected[0]}, got {given!r}")


def _types(kind: type) -> dict[str, Any]:
    """Return the types of a class's fields by name; empty if they can't be resolved at run time."""
    try:
        return get_type_hints(kind)
    except Exception:
        return {}
