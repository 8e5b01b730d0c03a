"""Public names of Surrogym: the design in this process, virtual environments, the client, and specifications.

Importing this package loads neither torch nor Gymnasium. Each name loads what it needs on first use.

Examples:
    >>> import surrogym
    >>> design = surrogym.Design(spec, budget=20)
    >>> while (query := design.ask()) is not None:
    ...     design.tell(query, machine.step_from(query.coordinates, query.action))
    >>> env = surrogym.make(design)
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from surrogym.design import Design, QueriesOpen, Query
    from surrogym.environments import make, make_sb3, make_vec
    from surrogym.prior import Prior
    from surrogym_client.transport.api import Api as Client
    from surrogym_sampler.logs import Imported, UnusableLog, import_log
    from surrogym_sampler.original.errors import StepRefused
    from surrogym_shared.nouns import RealStep
    from surrogym_shared.spec import (
        AcquisitionChoice,
        AllOf,
        Bounds,
        BoxAction,
        Choice,
        Coordinate,
        DeclaredReward,
        DiscreteAction,
        EnvironmentSpec,
        Fixed,
        Inequality,
        Lag,
        Limit,
        Limits,
        ModelChoice,
        MultiDiscreteAction,
        Normal,
        ObservationEntry,
        Part,
        Quantity,
        Reward,
        RewardTerm,
        Success,
        Term,
        Uniform,
        with_history,
    )
    from surrogym_shared.spec import Design as DesignSettings

__all__ = [
    "AcquisitionChoice",
    "AllOf",
    "Bounds",
    "BoxAction",
    "Choice",
    "Client",
    "Coordinate",
    "DeclaredReward",
    "Design",
    "DesignSettings",
    "DiscreteAction",
    "EnvironmentSpec",
    "Fixed",
    "Imported",
    "Inequality",
    "Lag",
    "Limit",
    "Limits",
    "ModelChoice",
    "MultiDiscreteAction",
    "Normal",
    "ObservationEntry",
    "Part",
    "Prior",
    "Quantity",
    "QueriesOpen",
    "Query",
    "RealStep",
    "Reward",
    "RewardTerm",
    "StepRefused",
    "Success",
    "Term",
    "Uniform",
    "UnusableLog",
    "import_log",
    "make",
    "make_sb3",
    "make_vec",
    "with_history",
]

# Module, name in the module, and extra that installs the module's packages, by public name. All other names are from
# surrogym_shared.spec.
_LAZY = {
    "Design": ("surrogym.design", "Design", "server"),
    "Query": ("surrogym.design", "Query", "server"),
    "QueriesOpen": ("surrogym.design", "QueriesOpen", "server"),
    "Prior": ("surrogym.prior", "Prior", "server"),
    "make": ("surrogym.environments", "make", ""),
    "make_sb3": ("surrogym.environments", "make_sb3", ""),
    "make_vec": ("surrogym.environments", "make_vec", ""),
    "RealStep": ("surrogym_shared.nouns", "RealStep", ""),
    "StepRefused": ("surrogym_sampler.original.errors", "StepRefused", ""),
    "Imported": ("surrogym_sampler.logs", "Imported", ""),
    "UnusableLog": ("surrogym_sampler.logs", "UnusableLog", ""),
    "import_log": ("surrogym_sampler.logs", "import_log", ""),
    "Client": ("surrogym_client.transport.api", "Api", ""),
    "DesignSettings": ("surrogym_shared.spec", "Design", ""),
}


def __getattr__(name: str) -> Any:
    """Import a public name of this package on its first use.

    Raises:
        ImportError: a package is missing; the message names the extra to install.
    """
    if name not in __all__:
        raise AttributeError(f"module 'surrogym' has no attribute {name!r}")
    module, attribute, extra = _LAZY.get(name, ("surrogym_shared.spec", name, ""))
    try:
        value = getattr(import_module(module), attribute)
    except ModuleNotFoundError as error:
        what = f"surrogym[{extra}]" if extra else "surrogym"
        raise ImportError(f"surrogym.{name} needs the package {error.name}: pip install '{what}'") from error
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
