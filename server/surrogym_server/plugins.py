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
TYPES: dict[Any, tuple[str, tuple[type, ...]]] = {  # of settings: in words, and the types in a specification
    float: ("a number", (int, float)),
    int: ("a whole number", (int,)),
    bool: ("true or false", (bool,)),
    str: ("a text", (str,)),
}


@dataclass(frozen=True)
class Choice:
    """A member of a registry by its name, and its settings."""

    name: str
    settings: tuple[tuple[str, float | bool | str], ...] = ()


class Registry(plugins.Registry[T]):
    """Classes by name, and members made of them. Apart from the name, nothing in a request decides what is loaded."""

    def lack(self, choice: Choice) -> str | None:
        """Describe what this machine lacks for a stored choice, to follow "it needs"; None if nothing."""
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
        """Return the class with a name.

        Raises:
            InvalidSpec: there is none, or its package is broken; the message lists the known names.
        """
        try:
            return super().get(name)
        except plugins.UnknownMember as error:
            raise InvalidSpec(str(error)) from None

    def make(self, choice: Choice) -> T:
        """Make the member with a name and its settings, which are the fields of a frozen dataclass.

        Raises:
            InvalidSpec: an unknown name, an unknown setting, or an invalid value.
        """
        kind, settings = self.get(choice.name), dict(choice.settings)
        with guarded(f"{self.kind} {choice.name}", InvalidSpec):
            _check_settings(kind, settings)
            return kind(**settings)


@contextmanager
def guarded(what: str, failure: type[SurrogymError], *, interrupts: bool = False) -> Iterator[None]:
    """Run code that may belong to another package. Every error becomes a ``failure`` whose message begins with
    ``what``, except errors that the server raises on purpose.

    This code refuses a specification by a ``ValueError``, so with ``InvalidSpec`` the message of a ``ValueError`` is
    enough; for other errors the type is added. ``KeyboardInterrupt`` passes, for example while a package is loaded,
    unless ``interrupts`` is set: in a server's requests, where a person's Ctrl-C arrives differently.
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
    """The error that ``guarded`` raises."""
    refused = isinstance(error, ValueError) and failure is InvalidSpec
    return failure(f"{what}: {plugins.one_line(error, typed=not refused)}")


def in_one_line(error: BaseException) -> str:
    """Describe an error in one line: the message of an error of this package, or the type and message of
    another one."""
    return plugins.one_line(error, typed=not isinstance(error, SurrogymError))


def _check_settings(kind: type, settings: dict[str, float | bool | str]) -> None:
    """Check settings against the fields of a class. Raises ``ValueError`` for an unknown, missing or wrongly
    typed one."""
    fields = [field for field in dataclasses.fields(kind) if field.init] if dataclasses.is_dataclass(kind) else []
    names = ", ".join(field.name for field in fields)
    if unknown := sorted(set(settings) - {field.name for field in fields}):
        raise ValueError(f"expected {f'a setting out of {names}' if names else 'no settings'}, got {unknown[0]!r}")
    for field in fields:
        needed = field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING
        if needed and field.name not in settings:
            raise ValueError(f"expected the setting {field.name}, which has no default; its settings are {names}")
    types = _types(kind)
    for name, given in settings.items():
        expected = TYPES.get(types.get(name))
        if expected is not None and type(given) not in expected[1]:
            raise ValueError(f"expected {name} to be {expected[0]}, got {given!r}")


def _types(kind: type) -> dict[str, Any]:
    """Types of the fields of a class; empty if they name types that only a type checker imports."""
    try:
        return get_type_hints(kind)
    except Exception:
        return {}
