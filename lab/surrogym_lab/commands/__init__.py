"""The commands of ``python -m surrogym_lab``: repeat the experiments behind the figures in the documentation. Each file
is one study, but for ``demo``, which is one run of a study."""

from __future__ import annotations

import typer

from surrogym_lab.commands import demo, efficiency, paper, peers, table, trust

COMMANDS = (demo, efficiency, paper, trust, peers, table)


def build() -> typer.Typer:
    """Assemble the commands."""
    app = typer.Typer(
        help="Repeat the experiments of the documentation.\n\nExample: python -m surrogym_lab efficiency --seeds 3",
        no_args_is_help=True,
        rich_markup_mode=None,
        pretty_exceptions_enable=False,
    )
    for command in COMMANDS:
        command.register(app)
    return app
