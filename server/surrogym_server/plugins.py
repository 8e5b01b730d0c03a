"""Families that others may add to: built-in members, and those of installed packages, found by entry points.

A package adds a member by an entry point in the group of the registry. It is loaded on the machine of the person who
installed it, when a name that is not built in is first looked up or the names are listed; never because of what a
request holds beside a name.
"""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.metadata import EntryPoint, entry_points
from typing import Generic, TypeVar

from surrogym_server.errors import InvalidSpec

logger = logging.getLogger(__name__)

T = TypeVar("T")


@dataclass(frozen=True)
class Choice:
    """A member of a registry by its name, and its settings."""

    name: str
    settings: tuple[tuple[str, float | bool | str], ...] = ()


class Registry(Generic[T]):
    """Classes by name."""

    def __init__(self, kind: str, group: str, base: type[T], built_in: Mapping[str, type[T]]) -> None:
        """
        Args:
            kind: what its members are, for messages: "acquisition".
            group: of the entry points of other packages.
            base: what each member is a subclass of.
            built_in: members of this package; no other package may take their names.
        """
        self.kind = kind
        self._group = group
        self._base = base
        self._built_in = dict(built_in)
        self._installed: dict[str, type[T]] | None = None
        self.broken: dict[str, str] = {}  # one sentence for each entry point that could not be used

    @property
    def names(self) -> tuple[str, ...]:
        """All names, the built-in ones first."""
        return (*self._built_in, *self._others())

    def get(self, name: str) -> type[T]:
        """The class of a name.

        Raises:
            InvalidSpec: there is none, or its package is broken; says which names there are.
        """
        if (found := self._built_in.get(name) or self._others().get(name)) is not None:
            return found
        reason = f" ({self.broken[name]})" if name in self.broken else ""
        raise InvalidSpec(f"{self.kind}: expected one of {', '.join(self.names)}, got {name!r}{reason}")

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

    def _others(self) -> dict[str, type[T]]:
        if self._installed is None:
            self._installed = {}
            for entry in entry_points(group=self._group):
                if (member := self._load(entry)) is not None:
                    self._installed[entry.name] = member
        return self._installed

    def _load(self, entry: EntryPoint) -> type[T] | None:
        """The class of an entry point; None, and a sentence in the log, where it can't be used."""
        try:
            self._check_name(entry.name)
            member = entry.load()
            self._check_class(member)
        except Exception as error:  # another package's code: whatever it raises must not end the server
            package = "a package" if entry.dist is None else f"package {entry.dist.name!r}"
            why = f"{package}, entry point {entry.name} = {entry.value!r} of {self._group}: {error}"
            self.broken[entry.name] = why
            logger.warning("the %s %r is left out: %s", self.kind, entry.name, why)
            return None
        loaded: type[T] = member
        return loaded

    def _check_name(self, name: str) -> None:
        if name in self._built_in:
            raise ValueError(f"expected another name than the built-in {self.kind}s {', '.join(self._built_in)}")

    def _check_class(self, member: object) -> None:
        if not (isinstance(member, type) and issubclass(member, self._base)):
            raise TypeError(f"expected a subclass of {self._base.__module__}.{self._base.__name__}, got {member!r}")
        if missing := sorted(getattr(member, "__abstractmethods__", ())):
            raise TypeError(f"expected {', '.join(missing)} to be implemented in {member.__name__}")
