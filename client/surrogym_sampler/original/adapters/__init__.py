"""Adapters that open a simulator by its name: any Gymnasium id, ``dm_control:DOMAIN-TASK``, ``pcgym:MODEL`` or
``pcgym:FILE.json``, ``fmu:PLANT.fmu``, ``fmu:PLANT.json`` or ``mujoco:FILE.xml``.

Each adapter opens one kind of simulator. Its packages are an optional extra, imported when a name needs them.
"""

from __future__ import annotations

import re
from importlib import import_module
from typing import NamedTuple

from pydantic import ValidationError

from surrogym_sampler.original.errors import RAISED, UnknownEnvironment, sentence
from surrogym_sampler.original.simulator import Simulator
from surrogym_shared.environments import GYMNASIUM_ID
from surrogym_shared.faults import first_fault

# names that bring their own specification: a program, or package.module:factory
WITH_SPECIFICATION = re.compile(r"exec:.*|[A-Za-z_][\w.]*:[A-Za-z_]\w*")


class Adapter(NamedTuple):
    """An adapter for one package of environments, such as dm_control.

    Attributes:
        module: Python module of the adapter, which is imported when it is needed.
        names: pattern of the names of environments that the adapter opens.
        trusted: pattern of the names that a client opens even if they come from a server and no person has agreed. Such
            names can open nothing but the package's own environments.
        extra: pip extra that installs the package.
        separate: whether its simulators run in processes of their own.
        pays: whether its simulators have rewards.
    """

    module: str
    names: re.Pattern[str]
    trusted: re.Pattern[str]
    extra: str
    separate: bool = False
    pays: bool = True


NEVER = re.compile(r"(?!)")
ADAPTERS = (
    Adapter(
        "surrogym_sampler.original.adapters.dm_control",
        re.compile(r"dm_control:.*"),
        re.compile(r"dm_control:[a-z0-9_]+-[a-z0-9_]+"),
        "dm-control",
    ),
    Adapter(
        "surrogym_sampler.original.adapters.pcgym.adapter", re.compile(r"pcgym:.*"), re.compile(r"pcgym:cstr"), "pcgym"
    ),
    Adapter("surrogym_sampler.original.fmus.adapter", re.compile(r"fmu:.*"), NEVER, "fmu", separate=True, pays=False),
    Adapter("surrogym_sampler.original.adapters.mujoco_file", re.compile(r"mujoco:.*"), NEVER, "mujoco", pays=False),
    Adapter(
        "surrogym_sampler.original.adapters.gymnasium_ids",
        re.compile(r"gymnasium_robotics:.*"),
        re.compile(r"gymnasium_robotics:[\w-]+-v\d+"),
        "robotics",
    ),
    Adapter("surrogym_sampler.original.adapters.gymnasium_ids", GYMNASIUM_ID, NEVER, "mujoco"),
)


def adapter_of(name: str) -> Adapter | None:
    """Return the adapter that opens this name; None for ``package.module:factory`` and for other texts."""
    return next((adapter for adapter in ADAPTERS if adapter.names.fullmatch(name)), None)


def is_trusted(name: str) -> bool:
    """Return whether a name that came from a server may be opened without consent: it can open only environments of
    known packages."""
    return any(adapter.trusted.fullmatch(name) for adapter in ADAPTERS)


def with_colon(name: str) -> str:
    """Return the end of a message that suggests ``module:Class`` for ``module.Class``; empty for other names."""
    module, _, attribute = name.rpartition(".")
    is_dotted = all(part.isidentifier() for part in (*module.split("."), attribute))
    return f"; did you mean {module}:{attribute}?" if is_dotted else ""


def open_simulator(name: str) -> Simulator:
    """Open the simulator with this name.

    Raises:
        UnknownEnvironment: no adapter knows the name, its package is not installed, or the simulator fails or can't be
            used.
    """
    adapter = adapter_of(name)
    if adapter is None and WITH_SPECIFICATION.fullmatch(name):
        raise UnknownEnvironment(
            f"{name} is a factory or a program, which gives its own specification: there is nothing to describe. To "
            "describe a Gymnasium class without a specification, register it with Gymnasium, and give package:Id-v0"
        )
    if adapter is None:
        raise UnknownEnvironment(
            f"no adapter knows the environment {name!r}: expected a Gymnasium id such as Pendulum-v1, package:Id-v0, "
            f"dm_control:DOMAIN-TASK, pcgym:cstr, pcgym:FILE.json, fmu:PLANT.fmu, fmu:PLANT.json or mujoco:FILE.xml"
            + with_colon(name)
        )
    try:
        opened: Simulator = import_module(adapter.module).open_simulator(name)
    except ImportError as error:
        raise UnknownEnvironment(f"{name} can't be made: {error} (pip install 'surrogym[{adapter.extra}]')") from error
    except UnknownEnvironment:
        raise
    except ValidationError as error:
        raise UnknownEnvironment(
            f"{name} does not fit into a specification: {first_fault(error)}; correct the environment"
        ) from error
    except RAISED as error:
        raise UnknownEnvironment(f"{name} can't be opened: {sentence(error)}") from error
    return opened
