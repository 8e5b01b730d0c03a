"""``python -m surrogym_lab table``: merge the rows of several runs and machines into one table."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from surrogym.cli.groups import add
from surrogym.cli.options import AsJson, Quiet

if TYPE_CHECKING:
    from surrogym_lab.reproduce.rows import Row


def register(app: typer.Typer) -> None:
    """Add ``python -m surrogym_lab table`` to the app."""
    add(app, "table", command)


def command(
    rows: Annotated[
        list[Path],
        typer.Option(help="File of rows. May be given several times; a later file replaces rows of an earlier one."),
    ],
    out: Annotated[Path, typer.Option(help="Folder for the merged efficiency.csv, the table and the pictures.")] = Path(
        "runs/table"
    ),
    page: Annotated[
        Path | None,
        typer.Option(
            help="Put tables and pictures into this page instead, between its marks: headline, efficiency, or both."
        ),
    ] = None,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Merge files of rows into one table.

    The folder --out gets efficiency.csv, efficiency.md and a picture of each task.

    Example: python -m surrogym_lab table --rows night/rows.csv --rows day/rows.csv --out runs/table
    """
    from surrogym.cli.errors import CommandError
    from surrogym_lab.reproduce.page import update
    from surrogym_lab.reproduce.rows import merge, read_rows, write_rows
    from surrogym_shared.terminal import give

    if missing := [path for path in rows if not path.exists()]:
        raise CommandError(f"expected a file of rows, got {missing[0]}, which does not exist")
    merged = merge(*map(read_rows, rows))
    write_rows(out / "efficiency.csv", merged)
    if page is None:
        present(merged, out, as_json=as_json, quiet=quiet)
    else:
        update(page, merged, out)
        words = f"{page} shows {len(merged)} rows"
        give({"page": str(page), "rows": len(merged)}, lambda: words, as_json=as_json, quiet=quiet)


def present(rows: Sequence[Row], out: Path, *, as_json: bool, quiet: bool) -> None:
    """Write the table and the pictures of rows, and print the table."""
    from surrogym_lab.reproduce.markdown import fitted
    from surrogym_lab.reproduce.table import report
    from surrogym_shared.terminal import give, progress

    with progress("table", quiet=quiet) as update:
        update(0.0, f"drawing {len(rows)} rows")
        from surrogym_lab.reproduce.pictures import draw_tasks

        text = report(rows)
        (out / "efficiency.md").write_text(text, encoding="utf-8")
        pictures = draw_tasks(out, rows)
        update(1.0, "done")
    result = {"out": str(out), "rows": [vars(row) for row in rows], "pictures": [str(path) for path in pictures]}
    give(result, lambda: fitted(text), as_json=as_json, quiet=quiet)
