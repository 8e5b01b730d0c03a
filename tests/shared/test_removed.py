"""A name that earlier versions knew is refused in one sentence that says what takes its place."""

from __future__ import annotations

import pytest

from surrogym_shared.plugins import Registry, UnknownMember
from surrogym_shared.removed import REMOVED, instead_of, remark

NAMES = [(kind, name) for kind, names in REMOVED.items() for name in names]


class Thing:
    """What members are."""


@pytest.mark.parametrize(("kind", "name"), NAMES)
def test_the_error_for_every_removed_name_states_its_replacement(kind: str, name: str) -> None:
    instead = instead_of(kind, name)
    assert instead
    assert "\n" not in instead
    assert remark(kind, name.upper()) == f"; {name.upper()!r} was removed: {instead}"


def test_the_error_for_an_unknown_name_states_no_replacement() -> None:
    assert remark("model", "nobody") == ""
    assert instead_of("nothing", "selected") is None


def test_a_registry_lookup_of_a_removed_name_states_its_replacement() -> None:
    registry = Registry("model", "surrogym.things_of_a_test", Thing, {"plain": Thing})
    with pytest.raises(UnknownMember) as refused:
        registry.get("selected")
    assert str(refused.value).endswith(f"got 'selected'{remark('model', 'selected')}")
    with pytest.raises(UnknownMember, match=r"got 'nobody'$"):
        registry.get("nobody")
