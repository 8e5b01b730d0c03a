"""A fresh install gets exactly what was tested: everything the extras need is pinned, to what is installed here."""

from __future__ import annotations

import re
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path

import pytest
from packaging.utils import canonicalize_name

from support.distributions import needed

ROOT = Path(__file__).parents[2]
PIN = re.compile(r"([A-Za-z0-9][A-Za-z0-9._-]*)==([A-Za-z0-9.!]+)")


def lines() -> list[str]:
    text = (ROOT / "constraints.txt").read_text(encoding="utf-8")
    return [line for line in text.splitlines() if line and not line.startswith("#")]


def test_every_constraint_line_pins_an_exact_released_version() -> None:
    assert [line for line in lines() if not PIN.fullmatch(line)] == []


def test_no_package_is_pinned_twice_in_the_constraints() -> None:
    names = [canonicalize_name(line.partition("==")[0]) for line in lines()]
    assert len(names) == len(set(names))


def test_every_dependency_of_the_extras_is_pinned_to_its_installed_version() -> None:
    pins = {canonicalize_name(name): version for name, version in (line.split("==") for line in lines())}
    try:
        names = needed("surrogym[dev]", {}).keys() - {"surrogym"}
    except PackageNotFoundError as missing:
        pytest.fail(f"not all of surrogym[dev] is installed here: {missing}")
    names -= {"pip"}  # comes with the virtual environment, before any pin is read
    installed = {name: distribution(name).version.partition("+")[0] for name in names}
    assert {name: (pins.get(name), version) for name, version in installed.items() if pins.get(name) != version} == {}
