"""Makes the page of all commands while the site is built, from the source of ``surrogym COMMAND --help``, and puts
every decision into the navigation."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click
import typer
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

from surrogym.cli import build

PAGE = "reference/commands.md"


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Adds the pages of decisions behind their index, the last entry of the last section."""
    (section,) = config.nav[-1].values()
    assert section[-1] == "decisions/README.md"
    pages = sorted(Path(config.docs_dir, "decisions").glob("[0-9]*.md"))
    section.extend(f"decisions/{path.name}" for path in pages)
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Adds the page to those of the folder."""
    files.append(File.generated(config, PAGE, content=page(typer.main.get_command(build()))))
    return files


def page(program: Any) -> str:
    """One section for each command: what it does, its arguments and options."""
    sections = [f"# Commands\n\nMade from the code. {program.help or ''}\n"]
    for words, command in commands(program, ("surrogym",)):
        sections.append(f"## {' '.join(words)}\n\n{paragraphs(command.help)}\n\n{table(command)}\n")
    return "\n".join(sections)


def commands(group: Any, words: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Every command with the words that name it; those of a group in its place."""
    for name, command in sorted(group.commands.items()):
        if hasattr(command, "commands"):
            yield from commands(command, (*words, name))
        elif not command.hidden:
            yield (*words, name), command


def paragraphs(text: str | None) -> str:
    """Help as Markdown: the line of the example stands as code."""
    lines = (text or "").replace("\f", "").splitlines()
    return "\n".join(f"    {line.partition(': ')[2]}" if line.startswith("Example: ") else line for line in lines)


def table(command: Any) -> str:
    """Arguments and options; defaults are in their descriptions, or beside them."""
    context = click.Context(command)
    rows = ["| argument or option | |", "|---|---|"]
    for parameter in command.params:
        record = parameter.get_help_record(context)
        if record is not None:
            rows.append(f"| `{record[0]}` | {cell(record[1])} |")
    return "\n".join(rows)


def cell(text: str) -> str:
    """Text in a row of a table: brackets are no references, bars end no cell."""
    return re.sub(r"[\[\]|]", r"\\\g<0>", " ".join(text.split()))
