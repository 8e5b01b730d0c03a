"""Families that the specification chooses from by name and settings, and that installed packages may add to."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import TypeVar

from surrogym_server.errors import InvalidSpec
from surrogym_shared import plugins

T = TypeVar("T")


@dataclass(frozen=True)
class Choice:
    """A member of a registry by its name, and its settings."""

    name: str
    settings: tuple[tuple[str, float | bool | str], ...] = ()


class Registry(plugins.Registry[T]):
    """Classes by name, and members made of them. Nothing is loaded because of what a request holds beside a name."""

    def get(self, name: str) -> type[T]:
        """The class of a name.

        Raises:
            InvalidSpec: there is none, or its package is broken; says which names there are.
        """
        try:
            return super().get(name)
        except plugins.UnknownMember as error:
            raise InvalidSpec(str(error)) from None

    def make(self, choice: Choice) -> T:
        """The member of a name, with its settings: the fields of a frozen dataclass.

        Raises:
            InvalidSpec: an unknown name, or settings that it does not have or take.
        """
        kind, settings = self.get(choice.name), dict(choice.settings)
        known: list[str] = [field.name for field in dataclasses.fields(kind)] if dataclasses.is_dataclass(kind) else []
        if unknown := sorted(set(settings) - set(known)):
            expected = f"one of {', '.join(known)}" if known else "none"
            raise InvalidSpec(f"{self.kind} {choice.name}: expected as settings {expected}, got {unknown[0]!r}")
        try:
            return kind(**settings)
        except (TypeError, ValueError) as error:
            raise InvalidSpec(f"{self.kind} {choice.name}: {error}") from None
