"""Groups of command-line options: frozen dataclasses whose fields are options, which several commands share."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable
from dataclasses import MISSING, Field, dataclass, fields, is_dataclass
from functools import wraps
from inspect import Parameter, Signature
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_type_hints

import typer

from surrogym.cli.options import AsJson, Quiet, Server, Token, TokenFile, TrustPolicy, connect, token_from
from surrogym_shared.terminal import give

if TYPE_CHECKING:
    from surrogym_client.transport import Api
    from surrogym_shared.spec import EnvironmentSpec
    from surrogym_trainer.policies.card import PolicyCard
    from surrogym_trainer.policies.predict import Acting, Predict


@dataclass(frozen=True)
class Service:
    """Options of the server and its token."""

    server: Server = None
    token: Token = None
    token_file: TokenFile = None

    def token_for(self, context: typer.Context) -> str | None:
        """Return the bearer token for the server; None without one. Raises the errors of ``token_from``."""
        return token_from(context, self.token, self.token_file)

    def connect(self, context: typer.Context, wait: float = 0.0, *, quiet: bool = False) -> Api:
        """Connect to the server, and wait up to ``wait`` seconds until it answers. Raises ``SurrogymClientError``."""
        return connect(self.server, self.token_for(context), wait, quiet=quiet)


@dataclass(frozen=True)
class Output:
    """Options of how a command shows its result."""

    as_json: AsJson = False
    quiet: Quiet = False

    def give(self, result: dict[str, Any], words: Callable[[], str]) -> None:
        """Print the result of a command: ``result`` as JSON, or the text that ``words`` returns."""
        give(result, words, as_json=self.as_json, quiet=self.quiet)


@dataclass(frozen=True)
class PolicyReading:
    """Options of how to read a policy file."""

    algorithm: Annotated[
        str | None,
        typer.Option(
            help="Algorithm of Stable-Baselines3 that wrote the file. [default: as noted beside the policy, or PPO]"
        ),
    ] = None
    trust_policy: TrustPolicy = False

    def load(self, policy: Path, card: PolicyCard) -> Predict:
        """Load the policy as a function of observations. Raises the errors of ``load_policy``."""
        from surrogym_trainer.policies.files import load_policy

        return load_policy(policy, self.algorithm or card.algorithm, trust=self.trust_policy)

    def acting(self, policy: Path, card: PolicyCard, given: EnvironmentSpec | None = None) -> Acting:
        """Load the policy as a controller of the original environment, whose specification is ``given`` or the card's.
        Raises the errors of ``load_policy``."""
        from surrogym_trainer.policies.integrals import acting_with_integrals

        return acting_with_integrals(self.load(policy, card), given or card.spec, card.integral, card.set_points)


def add(app: typer.Typer, name: str, command: Callable[..., None]) -> None:
    """Add a command to an app. A parameter whose type is a dataclass of options becomes one option for each field."""
    app.command(name)(ungrouped(command))


def ungrouped(command: Callable[..., None]) -> Callable[..., None]:
    """Return the command with a separate parameter for each field of its dataclasses of options, as typer needs it."""
    asked = inspect.signature(command, eval_str=True).parameters.values()
    groups: dict[str, Any] = {one.name: one.annotation for one in asked if is_dataclass(one.annotation)}
    flat = [option for parameter in asked for option in _flattened(parameter)]

    @wraps(command)
    def run(**given: Any) -> None:
        _require_finite(given)
        for name, group in groups.items():
            given[name] = group(**{field.name: given.pop(field.name) for field in fields(group)})
        command(**given)

    run.__signature__ = Signature(flat)  # type: ignore[attr-defined]
    run.__annotations__ = {parameter.name: parameter.annotation for parameter in flat}
    return run


def _require_finite(given: dict[str, Any]) -> None:
    """Check that all numbers among the options are finite, because NaN passes every range check.

    Raises:
        BadParameter: an option is NaN or infinite; the error names it.
    """
    for name, value in given.items():
        if isinstance(value, float) and not math.isfinite(value):
            raise typer.BadParameter(
                f"expected a finite number, got {value}", param_hint=f"'--{name.replace('_', '-')}'"
            )


def _flattened(parameter: Parameter) -> list[Parameter]:
    group = parameter.annotation
    if not is_dataclass(group):
        return [parameter.replace(kind=Parameter.KEYWORD_ONLY)]
    hints = get_type_hints(group, include_extras=True)
    return [
        Parameter(field.name, Parameter.KEYWORD_ONLY, default=_default(field), annotation=hints[field.name])
        for field in fields(group)
    ]


def _default(field: Field[Any]) -> Any:
    return Parameter.empty if field.default is MISSING else field.default
