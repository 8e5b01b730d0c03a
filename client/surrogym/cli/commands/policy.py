"""``surrogym policy``: show, send, download, name or delete one policy."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperGroup

from surrogym.cli.columns import columns
from surrogym.cli.groups import Output, Service, add

if TYPE_CHECKING:
    from surrogym_client.transport import Api
    from surrogym_shared.spec import EnvironmentSpec
    from surrogym_shared.wire import EvaluationView, PolicyDetail
    from surrogym_trainer.policies.card import PolicyCard

SHOW = "show"
Named = Annotated[
    str,
    typer.Argument(
        metavar="NAME@WHICH", help="Surrogate and policy, such as pendulum@3: a version, an alias, or latest."
    ),
]


class PolicyGroup(TyperGroup):
    """Command group that reads ``surrogym policy pendulum@3`` as ``surrogym policy show pendulum@3``."""

    default = SHOW

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Return the subcommand that the first argument names, or ``show`` if this argument names a policy."""
        named = bool(args) and args[0] not in self.commands and not args[0].startswith("-")
        return super().resolve_command(ctx, [self.default, *args] if named else args)


def group() -> typer.Typer:
    """Return ``surrogym policy`` with its subcommands."""
    parts = typer.Typer(
        cls=PolicyGroup,
        help="Show, store, download, name or delete a policy. surrogym policies lists all of them.\n\n"
        "Example: surrogym policy pendulum@3",
        no_args_is_help=True,
        rich_markup_mode=None,
    )
    for name, command in ((SHOW, show), ("push", push), ("get", get), ("alias", alias), ("delete", delete)):
        add(parts, name, command)
    return parts


def show(context: typer.Context, policy: Named, *, service: Service, output: Output) -> None:
    """Show a policy's promised return, real returns and files.

    Example: surrogym policy show pendulum@3
    """
    name, which = parsed(policy)
    with service.connect(context) as api:
        found = api.policies.get(name, which)
    output.give(found.model_dump(mode="json"), lambda: _words(name, found))


def push(
    context: typer.Context,
    policy: Annotated[Path, typer.Argument(help="Policy file, with its card beside it.")],
    surrogate: Annotated[
        str | None, typer.Option(help="Surrogate that the policy belongs to. [default: as noted in the card]")
    ] = None,
    forms: Annotated[
        list[str] | None,
        typer.Option(
            "--with", help="Also convert the policy to this form and send it: onnx or pt2. May be given several times."
        ),
    ] = None,
    *,
    service: Service,
    output: Output,
) -> None:
    """Store a policy on the server.

    The command sends the policy, its card, its training curve, and evaluations that are not stored yet. Sending a
    policy again is harmless. The server never loads the file.

    Example: surrogym policy push policy.zip
    """
    from surrogym_trainer.policies.card import read_card
    from surrogym_trainer.policies.pushing import push as send

    converted = {form: _converted(policy, form, read_card(policy).algorithm) for form in forms or ()}
    with service.connect(context) as api:
        sent = send(api, policy, surrogate)
        for form, content in converted.items():
            api.policies.put_file(sent.surrogate, sent.policy.version, form, content)  # type: ignore[arg-type]
    known = "stored" if sent.policy.created else "known already, its card is up to date"
    words = f"{sent.surrogate}@{sent.policy.version}: {known}; {sent.evaluations} evaluations sent"
    differs = f"; its specification differs in {sent.policy.differs}" if sent.policy.differs else ""
    result = {"surrogate": sent.surrogate, "evaluations": sent.evaluations, **sent.policy.model_dump(mode="json")}
    output.give(result, lambda: words + differs)


def get(
    context: typer.Context,
    policy: Named,
    out: Annotated[
        Path, typer.Option("--out", "-o", help="File to write. Its ending chooses the form: .zip, .onnx or .pt2.")
    ],
    *,
    service: Service,
    output: Output,
) -> None:
    """Download a policy and its card from the server.

    If the server does not have the form, the command converts it from the zip file.

    Example: surrogym policy get pendulum@production --out policy.zip
    """
    from surrogym_client.errors import UnknownPolicy
    from surrogym_trainer.policies.card import require_place, write_card

    name, which = parsed(policy)
    form: Any = out.suffix.lower().removeprefix(".")
    require_place(out)
    with service.connect(context) as api:
        name, found, card = stored_card(api, name, which)
        try:
            content = api.policies.file(name, found.version, form)
        except UnknownPolicy:
            if form not in ("onnx", "pt2"):
                raise
            content = _from_zip(api.policies.file(name, found.version, "zip"), form, card.algorithm)
    out.write_bytes(content)
    write_card(out, card)
    result = {"file": str(out), "bytes": len(content), "version": found.version}
    output.give(result, lambda: f"{out}: {len(content)} bytes of {name}@{found.version}, its card beside it")


def alias(
    context: typer.Context,
    policy: Named,
    name: Annotated[str, typer.Argument(help="Alias, such as production.")],
    remove: Annotated[bool, typer.Option("--remove", help="Remove the alias.")] = False,
    *,
    service: Service,
    output: Output,
) -> None:
    """Give a policy an alias, such as production.

    An alias names one policy of a surrogate at a time. This needs a token of role admin.

    Example: surrogym policy alias pendulum@3 production
    """
    surrogate, which = parsed(policy)
    with service.connect(context) as api:
        version = api.policies.get(surrogate, which).version
        if remove:
            api.policies.drop_alias(surrogate, name)
        else:
            api.policies.put_alias(surrogate, name, version)
    words = f"{surrogate}@{name} leads to {'nothing now' if remove else f'version {version}'}"
    output.give({"surrogate": surrogate, "alias": name, "version": None if remove else version}, lambda: words)


def delete(context: typer.Context, policy: Named, *, service: Service, output: Output) -> None:
    """Delete a policy with its files and evaluations.

    This needs a token of role admin, and can't be undone.

    Example: surrogym policy delete pendulum@3
    """
    name, which = parsed(policy)
    with service.connect(context) as api:
        found = api.policies.get(name, which)
        api.policies.delete(name, version := found.version)
    led = f", and nothing is left at {', '.join(f'{name}@{alias}' for alias in found.aliases)}" if found.aliases else ""
    output.give({"surrogate": name, "deleted": version}, lambda: f"{name}@{version} is deleted{led}")


def parsed(policy: str) -> tuple[str, str]:
    """Split ``NAME@WHICH`` into the surrogate's name and the policy's version or alias; ``latest`` without ``@``."""
    name, _, which = policy.partition("@")
    return name, which or "latest"


def stored_card(api: Api, name: str, which: str) -> tuple[str, PolicyDetail, PolicyCard]:
    """Return a policy that the server stores, with the name of its surrogate, and its card. The card contains the
    surrogate's specification if the policy was trained for this specification, otherwise none. In place of a copy,
    return the policy at the surrogate on which it was trained."""
    found = api.policies.get(name, which)
    if found.origin is not None:
        name, which = parsed(found.origin)
        found = api.policies.get(name, which)
    spec = api.surrogate(name).spec
    return name, found, _card(name, found, spec if found.differs is None else None)


def _card(name: str, found: PolicyDetail, spec: EnvironmentSpec | None) -> PolicyCard:
    """Rebuild the policy's card from the fields that the server stores."""
    from surrogym_trainer.policies.card import PolicyCard

    noted = found.model_dump(mode="json", include=set(PolicyCard.model_fields))
    if found.audit is not None and (found.audit.before is None or found.audit.after is None):
        del noted["audit"]
    return PolicyCard.model_validate({**noted, "surrogate": name, "spec": spec})


def _converted(policy: Path, form: str, algorithm: str) -> bytes:
    from surrogym_trainer.policies.export import export_policy

    with TemporaryDirectory() as folder:
        out = Path(folder) / f"policy.{form}"
        export_policy(policy, out, algorithm)
        return out.read_bytes()


def _from_zip(content: bytes, form: str, algorithm: str) -> bytes:
    with TemporaryDirectory() as folder:
        policy = Path(folder) / "policy.zip"
        policy.write_bytes(content)
        return _converted(policy, form, algorithm)


def _words(name: str, policy: PolicyDetail) -> str:
    from surrogym_shared.limits import words_of_fallbacks
    from surrogym_trainer.policies.card import limits_in, set_points_in, words_of_set_points

    aliases = f", {', '.join(policy.aliases)}" if policy.aliases else ""
    lines = [f"{name}@{policy.version}{aliases}: {policy.algorithm or 'unknown algorithm'}"]
    if policy.pushed_by is not None:
        lines.append(f"stored by: {policy.pushed_by}")
    if policy.origin is not None:
        lines.append(f"trained on another surrogate: its trust is that of {policy.origin}")
    if policy.virtual_steps:  # a planner has none
        lines.append(f"training: {policy.virtual_steps} virtual steps")
    if points := words_of_set_points(set_points_in(policy.settings)):
        lines.append(f"set points: {points}")
    if limits := limits_in(policy.settings):
        lines.append(f"limits at run time: {', '.join(limits)}")
    if policy.promise is None:
        lines.append("promise: none was made")
    else:
        promise, trusted = policy.promise, {True: "trusted", False: "not trusted", None: "not judged"}[policy.trusted]
        between = f"between {promise.low:.4g} and {promise.high:.4g} with 90 % chance"
        lines.append(f"promise: mean return {promise.median:.4g}, {between}; {trusted}: {policy.reason or '-'}")
        if (fallback := promise.fallback) is not None:
            expected = fallback.median if fallback.mean is None else fallback.mean
            lines.append(f"limits: {words_of_fallbacks(expected, fallback.low, fallback.high)}")
    if policy.differs:
        lines.append(f"made for another specification: it differs in {policy.differs}")
    files = [f"{one.form} {one.bytes} bytes" if one.stored else f"{one.form} missing" for one in policy.files]
    lines.append(f"files: {', '.join(files) or 'none'}")
    if policy.evaluations:
        heading = ("real episodes of", "environment", "starts", "episodes", "mean (95 %)", "success", "promise kept")
        lines.append(columns([heading, *map(_evaluation, policy.evaluations)]))
        limited = [one for one in policy.evaluations if one.limits is not None]
        lines += [
            f"limits, real episodes of {one.controller}, {one.note}: {one.limits.said}" for one in limited if one.limits
        ]
    else:
        lines.append(f"no real episodes yet; next: surrogym policy get {name}@{policy.version} --out policy.zip")
    return "\n".join(lines)


def _evaluation(one: EvaluationView) -> tuple[str | int, ...]:
    from surrogym.cli.commands.policies import words_of_mean

    success = "-" if one.success_rate is None else f"{one.success_rate:.0%}"
    kept = {True: "yes", False: "no", None: "not judged"}[one.promise_kept]
    environment = "its own" if one.own else one.environment
    return one.controller, environment, one.note or "-", one.episodes, words_of_mean(one), success, kept
