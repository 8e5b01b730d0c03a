"""Registries of named classes: built-in ones, and those of installed packages, found by entry points.

A package adds a class by an entry point in the group of the registry. The entry point is loaded in the process that
looks for a name that is not built in, or that lists the names.

If loading a package raises any exception, even ``SystemExit``, the exception is kept as one sentence, and everything
else continues to work. Only ``KeyboardInterrupt`` is raised again, because it may come from Ctrl-C, which must end the
program.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from typing import Generic, TypeVar

from surrogym_shared.removed import instead_of, remark

T = TypeVar("T")
MOST_CHARACTERS = 500  # longest text of a package's exception that a message shows


class UnknownMember(ValueError):
    """No class in a registry has this name, or the package of the class can't be loaded.

    The message lists the known names, and what replaces a removed one.
    """


class _Unfit(ValueError):
    """An entry point of a package can't be used, because it breaks a rule of the registry. The message has the rule."""


def one_line(error: BaseException, *, typed: bool = True) -> str:
    """Return an exception as one line, with its type if ``typed`` or if it has no message: ``SystemExit: 1``.

    Never raises, whatever the exception's own code does.
    """
    try:
        text = " ".join(str(error).split())
    except BaseException:
        text = ""
    if typed or not text:
        text = f"{type(error).__name__}: {text}" if text else type(error).__name__
    return text if len(text) <= MOST_CHARACTERS else f"{text[:MOST_CHARACTERS]}..."


class Registry(Generic[T]):
    """Registry of classes by name. Upper and lower case of names make no difference.

    Args:
        kind: word for the classes in messages, such as "algorithm".
        noun: word before a class's name in messages, such as "model family", if it differs from ``kind``.
        group: group of entry points by which other packages add classes.
        base: base class of all classes.
        built_in: classes by name, or ``module:class``, which is imported on first use; no other package may take these
            names.
    """

    def __init__(
        self, kind: str, group: str, base: type[T], built_in: Mapping[str, type[T] | str], noun: str = ""
    ) -> None:
        self.kind = kind
        self.noun = noun or kind
        self._group = group
        self._base = base
        self._built_in = dict(built_in)
        self._installed: dict[str, type[T]] | None = None
        self._broken: dict[str, str] = {}

    @property
    def names(self) -> tuple[str, ...]:
        """Return all names, the built-in ones first."""
        return (*self._built_in, *sorted(self._others()))

    @property
    def broken(self) -> Mapping[str, str]:
        """Return a sentence with the reason for each entry point that can't be used, by the entry point's name."""
        self._others()
        return self._broken

    def why_broken(self, name: str) -> str | None:
        """Return why the entry point ``name`` can't be used; None if it can, or if there is no such entry point."""
        return next((why for plugin, why in self.broken.items() if plugin.casefold() == name.casefold()), None)

    def instead_of(self, name: str) -> str | None:
        """Return what replaces a class that was removed in an earlier version; None if no such class was removed."""
        return instead_of(self.kind, name)

    def name_of(self, name: str) -> str:
        """Return the registered spelling of a name. Other packages are loaded only if the name is not built in.

        Raises:
            UnknownMember: no class has this name.
        """
        member = _same(name, self._built_in) or _same(name, self._others())
        if member is None:
            why = self.why_broken(name)
            because = remark(self.kind, name) if why is None else f" ({why})"
            raise UnknownMember(f"{self.kind}: expected one of {', '.join(self.names)}, got {name!r}{because}")
        return member

    def get(self, name: str) -> type[T]:
        """Return the class of this name. Raises ``UnknownMember`` if there is none."""
        member_name = self.name_of(name)
        if member_name not in self._built_in:
            return self._others()[member_name]
        built_in = self._built_in[member_name]
        if not isinstance(built_in, str):
            return built_in
        module, _, attribute = built_in.partition(":")
        member: type[T] = getattr(import_module(module), attribute)
        return member

    def _others(self) -> dict[str, type[T]]:
        if self._installed is None:
            installed, broken = dict[str, type[T]](), dict[str, str]()
            for entries in _by_name(entry_points(group=self._group)):
                try:
                    installed[entries[0].name] = self._load(entries)
                except KeyboardInterrupt:
                    raise
                except BaseException as error:  # code of another package may raise any exception
                    reason = str(error) if isinstance(error, _Unfit) else one_line(error)
                    broken[entries[0].name] = f"{self._described(entries)}: {reason}"
            self._installed, self._broken = installed, broken
        return self._installed

    def _described(self, entries: list[EntryPoint]) -> str:
        """Describe where entry points come from, as "package 'a', entry point x = 'a:X' of surrogym.models"."""
        parts = [f"{_package(entry)}, entry point {entry.name} = {entry.value!r}" for entry in entries]
        return f"{'; '.join(parts)} of {self._group}"

    def _load(self, entries: list[EntryPoint]) -> type[T]:
        """Load the class to which the entry point of one name refers. Raises ``_Unfit``, or what the module raises.

        If several packages add the same name, none is loaded, because the order of the search path must not decide.
        """
        if len(entries) > 1:
            raise _Unfit("several plug-ins have this name, so none of them is used: uninstall all but one")
        (entry,) = entries
        if _same(entry.name, self._built_in):
            raise _Unfit(
                f"expected a name that differs from the built-in ones ({', '.join(self._built_in)}), got {entry.name!r}"
            )
        member = entry.load()
        if not (isinstance(member, type) and issubclass(member, self._base)):
            raise _Unfit(f"expected a subclass of {self._base.__module__}.{self._base.__name__}, got {member!r}")
        if missing := sorted(getattr(member, "__abstractmethods__", ())):
            raise _Unfit(
                f"expected {member.__name__} to implement all abstract methods, but it lacks {', '.join(missing)}"
            )
        return member


def _same(name: str, members: Iterable[str]) -> str | None:
    """Return the name among ``members`` that equals ``name`` apart from upper and lower case; None if there is none."""
    return next((member for member in members if member.casefold() == name.casefold()), None)


def _by_name(entries: Iterable[EntryPoint]) -> list[list[EntryPoint]]:
    """Group entry points by name, in an order that does not depend on the search path."""
    together = defaultdict[str, list[EntryPoint]](list)
    for entry in sorted(entries, key=lambda entry: (entry.name.casefold(), _package(entry), entry.name, entry.value)):
        together[entry.name.casefold()].append(entry)
    return list(together.values())


def _package(entry: EntryPoint) -> str:
    return "a package" if entry.dist is None else f"package {entry.dist.name!r}"
