"""Registries of installed packages: one that can't be loaded is one sentence, and everything else works."""

from __future__ import annotations

from pathlib import Path

import pytest

from surrogym_shared.plugins import Registry, UnknownMember

GROUP = "surrogym.things_of_a_test"


class Thing:
    """What members are."""


class Plain(Thing):
    """The built-in one."""


class Sites:
    """Folders on the search path, each a package that brings one name."""

    def __init__(self, folder: Path, patch: pytest.MonkeyPatch) -> None:
        self.folder = folder
        self.patch = patch

    def add(self, package: str, name: str, body: str) -> None:
        site = self.folder / package
        written = site / f"{package}-1.0.dist-info"
        written.mkdir(parents=True)
        (written / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.0\n")
        (written / "entry_points.txt").write_text(f"[{GROUP}]\n{name} = {package}:Member\n")
        (site / f"{package}.py").write_text(body)
        self.patch.syspath_prepend(str(site))


GOOD = f"from {__name__} import Thing\nclass Member(Thing): ...\n"


@pytest.fixture
def sites(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Sites:
    return Sites(tmp_path, monkeypatch)


def registry() -> Registry[Thing]:
    return Registry("thing", GROUP, Thing, {"plain": Plain})


@pytest.mark.parametrize(
    ("body", "said"),
    [
        ("import sys; sys.exit('no licence')", "SystemExit: no licence"),
        ("import sys; sys.exit()", "SystemExit"),
        ("class Stop(BaseException): ...\nraise Stop('a tool ends the run')", "Stop: a tool ends the run"),
        ("raise RuntimeError('one line\\n    and another')", "RuntimeError: one line and another"),
        ("import nowhere_to_be_found", "ModuleNotFoundError: No module named 'nowhere_to_be_found'"),
        ("Member = int", f"expected a subclass of {__name__}.Thing, got <class 'int'>"),
    ],
)
def test_any_exception_of_a_plugin_module_becomes_a_one_sentence_error(sites: Sites, body: str, said: str):
    sites.add("bad_package", "bad", body)
    sites.add("good_package", "good", GOOD)
    things = registry()
    assert things.names == ("plain", "good")
    assert things.broken == {"bad": f"package 'bad_package', entry point bad = 'bad_package:Member' of {GROUP}: {said}"}
    with pytest.raises(UnknownMember, match="entry point bad = "):
        things.get("BAD")


def test_ctrl_c_while_loading_a_plugin_ends_the_program(sites: Sites):
    """One that a module raised by itself looks the same, and ends it too."""
    sites.add("interrupting", "interrupting", "raise KeyboardInterrupt")
    with pytest.raises(KeyboardInterrupt):
        _ = registry().names


def test_looking_up_a_built_in_name_loads_no_plugin(sites: Sites):
    sites.add("interrupting", "interrupting", "raise KeyboardInterrupt")
    assert registry().get("Plain") is Plain


@pytest.mark.parametrize("order", [("first", "second"), ("second", "first")])
def test_if_two_plugins_have_the_same_name_neither_is_used(sites: Sites, order: tuple[str, str]):
    for package in order:
        sites.add(package, "same" if package == "first" else "Same", GOOD)
    things = registry()
    assert things.names == ("plain",)
    assert things.broken == {
        "same": f"package 'first', entry point same = 'first:Member'; package 'second', entry point "
        f"Same = 'second:Member' of {GROUP}: several plug-ins have this name, so none of them is used: uninstall "
        "all but one"
    }


def test_a_plugin_cannot_take_a_built_in_name(sites: Sites):
    sites.add("thief", "PLAIN", GOOD)
    things = registry()
    assert things.get("plain") is Plain
    assert "expected a name that differs from the built-in ones (plain), got 'PLAIN'" in things.broken["PLAIN"]
