"""The help of the command line, with commands in groups and options for experts in a section of their own; and errors
that name the replacement of an option that was removed."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from typer.core import TyperCommand, TyperGroup

from surrogym_shared.removed import remark

GROUPS: Mapping[str, tuple[str, ...]] = {
    "Start": ("demo", "serve", "doctor"),
    "Loop": ("describe", "register", "sample", "prior", "train", "audit", "evaluate", "status"),
    "After": (
        *("report", "policies", "policy", "improve", "change", "export", "import", "export-policy", "deploy", "delete"),
    ),
    "Operate": ("watch", "work", "jobs", "conformance"),
}
REST = "More"  # heading, in the help, over the commands that belong to no group, such as those of other packages
ADVANCED: Mapping[str, frozenset[str]] = {  # for each command, the options for experts, which its help lists last
    "deploy": frozenset({"--algorithm", "--trust-policy", "--spec", "--episodes"}),
    "evaluate": frozenset(
        {"--wide", "--start-scale", "--perturb", "--explore", "--parallel", "--algorithm", "--where", "--learn"}
        | {"--learn-all", "--compare", "--reference", "--video"}
    ),
    "register": frozenset({"--preset", "--acquisition", "--initial", "--target", "--bins"}),
    "sample": frozenset(
        {"--worker", "--once", "--time-limit", "--most-snapshots", "--most-bytes", "--on-ray", "--ray-address"}
        | {"--ray-resources", "--runtime-env"}
    ),
    "serve": frozenset({"--synchronous", "--engine", "--ray-address", "--ray-hosts", "--ready-file"}),
    "train": frozenset(
        {"--variant", "--particles", "--spread", "--process-noise", "--start-box"}
        | {"--start-visited", "--horizon", "--penalty", "--trust", "--num-envs", "--audit-steps"}
        | {"--tensorboard"}
    ),
}


class Command(TyperCommand):
    """One command of ``surrogym``. Its help lists the options for experts last, under "Advanced"."""

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write the sections of arguments, options and advanced options to the help of a command."""
        sections: dict[str, list[tuple[str, str]]] = {"Arguments": [], "Options": [], "Advanced": []}
        advanced = ADVANCED.get(self.name or "", frozenset())
        for parameter in self.get_params(ctx):
            if (record := parameter.get_help_record(ctx)) is None:
                continue
            argument, expert = parameter.param_type_name == "argument", advanced.intersection(parameter.opts)
            sections["Arguments" if argument else "Advanced" if expert else "Options"].append(record)
        _write(formatter, sections)


class Commands(TyperGroup):
    """Group of all commands of ``surrogym``. The error about an option that was removed names its replacement."""

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write a section for each group of commands to the help of ``surrogym``."""
        known = {name: command for name in self.list_commands(ctx) if (command := self.get_command(ctx, name))}
        shown = {name: command for name, command in known.items() if not command.hidden}
        grouped = {name for names in GROUPS.values() for name in names}
        groups = {**GROUPS, REST: tuple(name for name in shown if name not in grouped)}
        width = max(map(len, shown), default=0)
        limit = formatter.width - 6 - width
        sections = {
            heading: [(name.ljust(width), shown[name].get_short_help_str(limit)) for name in names if name in shown]
            for heading, names in groups.items()
        }
        _write(formatter, sections)

    def invoke(self, ctx: Any) -> Any:
        """Run the command, and add the replacement of a removed option to the error about it."""
        try:
            return super().invoke(ctx)
        except Exception as error:
            # only NoSuchOption, a class that typer hides, has this attribute
            option = getattr(error, "option_name", None)
            if option is not None and (said := remark(f"option of {ctx.invoked_subcommand}", option)):
                error.message += said  # type: ignore[attr-defined]
                error.possibilities = None  # type: ignore[attr-defined]
            raise


def _write(formatter: Any, sections: Mapping[str, list[tuple[str, str]]]) -> None:
    for heading, rows in sections.items():
        if rows:
            with formatter.section(heading):
                formatter.write_dl(rows)
