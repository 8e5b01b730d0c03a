"""Families that others may add to: built-in members, and those of installed packages, found by entry points.

A package adds a member by an entry point in the group of the registry. It is loaded on the machine of the person who
installed it, when a name that is not built in is first looked up or the names are listed.
"""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from typing import Generic, TypeVar

T = TypeVar("T")


class UnknownMember(ValueError):
    """No member has this name, or its package is broken; the message lists the names that there are."""


class Registry(Generic[T]):
    """Classes by name; upper and lower case are the same.

    Args:
        kind: what its members are, for messages: "algorithm".
        group: of the entry points of other packages.
        base: what each member is a subclass of.
        built_in: classes by name, or ``module:class``, imported when it is first asked for; no other package may take
            these names.
    """

    def __init__(self, kind: str, group: str, base: type[T], built_in: Mapping[str, type[T] | str]) -> None:
        self.kind = kind
        self._group = group
        self._base = base
        self._built_in = dict(built_in)
        self._installed: dict[str, type[T]] | None = None
        self._broken: dict[str, str] = {}

    @property
    def names(self) -> tuple[str, ...]:
        """All names, the built-in ones first."""
        return (*self._built_in, *sorted(self._others()))

    @property
    def broken(self) -> Mapping[str, str]:
        """One sentence for each entry point that can't be used, by its name."""
        self._others()
        return self._broken

    def name_of(self, name: str) -> str:
        """A name as the registry has it.

        Raises:
            UnknownMember: no member has it.
        """
        for known in (self._built_in, self._others()):
            for member in known:
                if member.casefold() == name.casefold():
                    return member
        why = f" ({self.broken[name]})" if name in self.broken else ""
        raise UnknownMember(f"{self.kind}: expected one of {', '.join(self.names)}, got {name!r}{why}")

    def get(self, name: str) -> type[T]:
        """The class of a name. Raises as ``name_of``."""
        known = self.name_of(name)
        if known not in self._built_in:
            return self._others()[known]
        built_in = self._built_in[known]
        if not isinstance(built_in, str):
            return built_in
        module, _, attribute = built_in.partition(":")
        member: type[T] = getattr(import_module(module), attribute)
        return member

    def _others(self) -> dict[str, type[T]]:
        if self._installed is None:
            self._installed = {}
            for entry in entry_points(group=self._group):
                self._add(entry, self._installed)
        return self._installed

    def _add(self, entry: EntryPoint, installed: dict[str, type[T]]) -> None:
        """Add the class of an entry point, or say why it can't be used."""
        try:
            self._check_name(entry.name)
            member = entry.load()
            self._check_class(member)
            installed[entry.name] = member
        except Exception as error:  # another package's code may raise anything
            package = "a package" if entry.dist is None else f"package {entry.dist.name!r}"
            self._broken[entry.name] = (
                f"{package}, entry point {entry.name} = {entry.value!r} of {self._group}: {error}"
            )

    def _check_name(self, name: str) -> None:
        if name.casefold() in (known.casefold() for known in self._built_in):
            raise ValueError(f"expected another name than the built-in {', '.join(self._built_in)}")

    def _check_class(self, member: object) -> None:
        if not (isinstance(member, type) and issubclass(member, self._base)):
            raise TypeError(f"expected a subclass of {self._base.__module__}.{self._base.__name__}, got {member!r}")
        if missing := sorted(getattr(member, "__abstractmethods__", ())):
            raise TypeError(f"expected {', '.join(missing)} to be implemented in {member.__name__}")
