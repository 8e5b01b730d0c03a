"""The Gymnasium ids work, and the thin client stays thin. In other processes: imports can't be undone."""

import subprocess
import sys
from functools import partial

import gymnasium
import pytest

import surrogym_client
from surrogym_client.registration import ENVIRONMENT_ID, register


def run(code: str) -> str:
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_importing_the_package_registers_the_gymnasium_environment():
    code = "import gymnasium, surrogym_client; print(gymnasium.spec('surrogym/Remote-v0').entry_point)"
    assert run(code).strip() == "surrogym_client.environments.gym_factories:make_env"


def test_the_gymnasium_environment_is_registered_even_if_gymnasium_is_imported_later():
    code = (
        "import sys, surrogym_client; before = 'gymnasium' in sys.modules\n"
        "import gymnasium; loader = type(gymnasium.__spec__.loader).__name__\n"
        "print(before, gymnasium.spec('surrogym/File-v0').entry_point, loader)"
    )
    assert run(code).split() == ["False", "surrogym_client.environments.file_factories:make_env", "SourceFileLoader"]


def test_printing_help_loads_only_needed_packages():
    """Most of the time of a command that asks a server would be these."""
    code = (
        "import sys\nfrom surrogym.cli import build\nbuild()\n"
        "print({name for name in ('gymnasium', 'numpy', 'torch', 'httpx', 'pydantic', 'scipy') if name in sys.modules})"
    )
    assert run(code).strip() == "set()"


def test_gymnasium_make_accepts_an_id_that_names_the_package():
    code = (
        "import gymnasium\n"
        "try: gymnasium.make_vec('surrogym_client:surrogym/Remote-v0', url='nowhere', surrogate='x')\n"
        "except Exception as error: print(type(error).__name__, error)"
    )
    assert run(code).startswith("ServerUnreachable expected a server address")


def test_gymnasium_make_without_a_surrogate_name_tells_what_is_missing():
    for make in (gymnasium.make, partial(gymnasium.make_vec, num_envs=2)):
        with pytest.raises(
            ValueError, match=r'expected the name of a surrogate: gymnasium.make\("surrogym/Remote-v0", surrogate='
        ):
            make(ENVIRONMENT_ID, url="http://127.0.0.1:8000")


def test_registering_the_gymnasium_environment_twice_is_harmless():
    before = gymnasium.spec(ENVIRONMENT_ID)
    register()
    surrogym_client.register()
    assert gymnasium.spec(ENVIRONMENT_ID) is before


def test_client_sampler_and_trainer_can_be_imported_without_torch():
    """In one process, the thinnest first: which module brings it is on its line."""
    modules = (
        "surrogym_client.transport",
        "surrogym_client.environments",
        "surrogym_client.environments.gym_factories",
        "surrogym_sampler.queries",
        "surrogym_trainer.policies",
        "surrogym_trainer.training",
    )
    code = (
        "import importlib, sys\n"
        f"for module in {modules}:\n"
        "    importlib.import_module(module)\n"
        "    print(module, *{'torch', 'stable_baselines3'} & set(sys.modules))"
    )
    assert run(code).split() == list(modules)
