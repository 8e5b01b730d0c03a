"""Whoever lacks a package is told which extra brings it: every package of an extra is known."""

from __future__ import annotations

import re
import tomllib
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest
from packaging.utils import canonicalize_name

from surrogym_client.runtime.versions import EXTRAS, missing

PROJECT = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text())["project"]


@pytest.mark.parametrize("extra", ["server", "train", "export", "render", "mujoco"])
def test_every_package_of_an_extra_is_known_to_the_missing_package_hint(extra: str):
    modules: dict[str, set[str]] = {}
    for module, names in packages_distributions().items():
        for name in names:
            modules.setdefault(canonicalize_name(name), set()).add(module)
    for requirement in PROJECT["optional-dependencies"][extra]:
        name = canonicalize_name(re.match(r"[A-Za-z0-9_.-]+", requirement).group())
        if name not in map(canonicalize_name, (re.match(r"[\w.-]+", base).group() for base in PROJECT["dependencies"])):
            assert any(missing(module) for module in modules[name]), name


def test_the_missing_package_hint_names_package_and_extra():
    assert missing("cmaes") == "this needs cmaes, which is not installed: pip install 'surrogym[train]'"
    assert missing("json") is None
    assert set(EXTRAS) <= set(PROJECT["optional-dependencies"])
