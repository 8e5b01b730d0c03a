"""A machine with dirt, behind the executable's protocol, and a surrogate with real steps of it."""

from __future__ import annotations

import shlex
import sys
from contextlib import closing

from support.examples import EXAMPLES
from surrogym_client.transport import Api
from surrogym_sampler import original
from surrogym_sampler.queries import Sampler, SamplerSettings
from surrogym_shared.spec import EnvironmentSpec


def furuta(*options: str) -> str:
    """Return the name of the rotary pendulum of ``examples/machines``."""
    return f"exec:{shlex.join([sys.executable, str(EXAMPLES / 'machines' / 'furuta.py'), *options])}"


def learned(api: Api, name: str, *options: str) -> EnvironmentSpec:
    """Register a surrogate of the rotary pendulum, take 60 real steps, and return its specification."""
    with closing(original.make(furuta(*options), budget=60, initial=60)) as environment:
        api.create_surrogate(name, environment.spec())
        Sampler(api, name, environment, SamplerSettings(until_done=True, time_limit=100.0)).run()
        return environment.spec()
