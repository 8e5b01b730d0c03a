"""``surrogym reproduce``: repeat the experiments behind the figures in the documentation. Each file is one study."""

from __future__ import annotations

import typer

from surrogym_client.cli.reproduce import efficiency, paper, peers, table, trust

STUDIES = (efficiency, paper, trust, peers, table)


def register(app: typer.Typer) -> None:
    """Add ``surrogym reproduce`` and its studies to the app."""
    studies = typer.Typer(
        help="Repeat the experiments of the documentation.\n\nExample: surrogym reproduce efficiency --seeds 3",
        no_args_is_help=True,
        rich_markup_mode=None,
    )
    for study in STUDIES:
        study.register(studies)
    app.add_typer(studies, name="reproduce")
