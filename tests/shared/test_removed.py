"""A name that earlier versions knew is refused in one sentence that says what takes its place."""

from __future__ import annotations

import pytest

from surrogym_shared.plugins import Registry, UnknownMember
from surrogym_shared.removed import REMOVED, instead_of, remark

NAMES = [(kind, name) for kind, names in REMOVED.items() for name in names]


class Thing:
    """What members are."""


@pytest.mark.parametrize(("kind", "name"), NAMES)
def test_every_removed_name_says_what_takes_its_place(kind: str, name: str) -> None:
    instead = instead_of(kind, name)
    assert instead
    assert "\n" not in instead
    assert remark(kind, name.upper()) == f"; {name.upper()!r} was removed: {instead}"


def test_a_name_that_never_existed_has_no_successor() -> None:
    assert remark("model", "nobody") == ""
    assert instead_of("nothing", "selected") is None


def test_a_registry_that_refuses_a_removed_name_says_it() -> None:
    registry = Registry("model", "surrogym.things_of_a_test", Thing, {"plain": Thing})
    with pytest.raises(UnknownMember) as refused:
        registry.get("selected")
    assert str(refused.value).endswith(f"got 'selected'{remark('model', 'selected')}")
    with pytest.raises(UnknownMember, match=r"got 'nobody'$"):
        registry.get("nobody")
