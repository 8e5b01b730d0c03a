"""Options in groups: frozen dataclasses whose fields are options, shared by commands and passed on whole."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import MISSING, Field, dataclass, fields, is_dataclass
from functools import wraps
from inspect import Parameter, Signature
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_type_hints

import typer

from surrogym_client.cli.options import AsJson, Quiet, Server, Token, TokenFile, TrustPolicy, connect, token_from

if TYPE_CHECKING:
    from surrogym_client.policies.card import PolicyCard
    from surrogym_client.policies.predict import Predict
    from surrogym_client.transport import Api


@dataclass(frozen=True)
class Service:
    """Which server, and the token for it."""

    server: Server = None
    token: Token = None
    token_file: TokenFile = None

    def token_for(self, context: typer.Context) -> str | None:
        """The bearer token. Raises as ``token_from``."""
        return token_from(context, self.token, self.token_file)

    def connect(self, context: typer.Context, wait: float = 0.0, *, quiet: bool = False) -> Api:
        """The server, which must answer within ``wait`` seconds. Raises as ``connect``."""
        return connect(self.server, self.token_for(context), wait, quiet=quiet)


@dataclass(frozen=True)
class Output:
    """How a command shows its result."""

    as_json: AsJson = False
    quiet: Quiet = False

    def give(self, result: dict[str, Any], words: Callable[[], str]) -> None:
        """Print the result as JSON, or in words."""
        from surrogym_shared.terminal import give

        give(result, words, as_json=self.as_json, quiet=self.quiet)


@dataclass(frozen=True)
class PolicyReading:
    """How a policy's file is read."""

    algorithm: Annotated[
        str | None, typer.Option(help="Stable-Baselines3 algorithm of the file. [default: as noted beside it, or PPO]")
    ] = None
    trust_policy: TrustPolicy = False

    def load(self, policy: Path, card: PolicyCard) -> Predict:
        """The policy as a function of observations. Raises as ``load_policy``."""
        from surrogym_client.policies.files import load_policy

        return load_policy(policy, self.algorithm or card.algorithm, trust=self.trust_policy)


def add(app: typer.Typer, name: str, command: Callable[..., None]) -> None:
    """Add a command. Each parameter whose type is a group becomes the options of its fields, in their order."""
    app.command(name)(ungrouped(command))


def ungrouped(command: Callable[..., None]) -> Callable[..., None]:
    """The same command with the options of its groups as parameters of its own, as typer reads them."""
    asked = inspect.signature(command, eval_str=True).parameters.values()
    groups: dict[str, Any] = {one.name: one.annotation for one in asked if is_dataclass(one.annotation)}
    flat = [option for parameter in asked for option in _flattened(parameter)]

    @wraps(command)
    def run(**given: Any) -> None:
        for name, group in groups.items():
            given[name] = group(**{field.name: given.pop(field.name) for field in fields(group)})
        command(**given)

    run.__signature__ = Signature(flat)  # type: ignore[attr-defined]
    run.__annotations__ = {parameter.name: parameter.annotation for parameter in flat}
    return run


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
