"""What ``import surrogym`` promises: every name, nothing heavy, and a sentence where an extra is missing."""

from __future__ import annotations

import subprocess
import sys

import pytest

import surrogym
from support.server import ServerProcess
from surrogym_shared import spec

WITHOUT = """
import sys
for name in ({missing}):
    sys.modules[name] = None  # so that importing it fails, as where it is not installed
import surrogym
"""


def python(code: str) -> str:
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return run.stdout.strip()


@pytest.mark.parametrize("name", surrogym.__all__)
def test_every_exported_name_of_the_package_exists(name: str):
    assert getattr(surrogym, name) is not None


def test_an_unknown_name_of_the_package_raises_attribute_error():
    with pytest.raises(AttributeError, match="module 'surrogym' has no attribute 'Desing'"):
        surrogym.Desing  # noqa: B018


def test_the_package_exports_every_class_of_the_specification():
    classes = {name for name in spec.__all__ if isinstance(getattr(spec, name), type)} - {"Design"}
    assert classes <= set(surrogym.__all__)
    assert surrogym.DesignSettings is spec.Design


def test_importing_the_package_loads_no_heavy_dependency():
    heavy = python("import surrogym, sys; print([m for m in ('torch', 'gymnasium', 'httpx') if m in sys.modules])")
    assert heavy == "[]"


def test_the_error_for_a_name_that_needs_a_missing_extra_names_the_extra():
    code = WITHOUT.format(missing="'torch',") + (
        "try:\n    surrogym.Design\nexcept ImportError as error:\n    print(error)\n"
        "print(surrogym.make, surrogym.Client)"
    )
    said = python(code)
    assert said.startswith("surrogym.Design needs the package torch: pip install 'surrogym[server]'")


def test_make_opens_a_surrogate_of_a_server_by_name(pendulum_server: ServerProcess):
    env = surrogym.make("pendulum", url=pendulum_server.url)
    assert env.reset(seed=0)[0].shape == (3,)
    env.close()
    envs = surrogym.make_vec("pendulum", 3, url=pendulum_server.url)
    assert envs.reset(seed=0)[0].shape == (3, 3)
    envs.close()


def test_make_refuses_arguments_that_are_no_name_path_or_design():
    with pytest.raises(TypeError, match=r"expected the name of a surrogate, a path .* got int"):
        surrogym.make(3)
