"""Commands: the group of all commands, which says what takes the place of an option that was removed."""

from __future__ import annotations

from typing import Any

from typer.core import TyperGroup

from surrogym_shared.removed import remark


class Commands(TyperGroup):
    """Group of commands. An unknown option that a command once had is refused with its successor."""

    def invoke(self, ctx: Any) -> Any:
        """Run the named command."""
        try:
            return super().invoke(ctx)
        except Exception as error:
            option = getattr(error, "option_name", None)  # of NoSuchOption, which newer versions of typer have inside
            if option is not None and (said := remark(f"option of {ctx.invoked_subcommand}", option)):
                error.message += said  # type: ignore[attr-defined]
                error.possibilities = None  # type: ignore[attr-defined]
            raise
