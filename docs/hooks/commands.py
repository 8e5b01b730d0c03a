"""Makes two pages while the site is built: the commands from the source of ``surrogym COMMAND --help``, and the routes
from the server's OpenAPI. Names the paths of records, which are in the repository and not in the site."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import click
import typer
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

from surrogym.cli import build
from surrogym_server.app import create_app
from surrogym_server.settings import Settings

PAGE, ROUTES = "reference/commands.md", "reference/http.md"
LINK = re.compile(r"(?<!!)\[([^\]]*)\]\(([^)\s]+)\)")


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, **_: Any) -> str:
    """Replaces each link to a file outside the site, such as a record of the lab, by its text and path."""
    folder = Path(config.docs_dir, page.file.src_uri).parent
    return LINK.sub(lambda link: outside(link, folder, Path(config.docs_dir)), markdown)


def outside(link: re.Match[str], folder: Path, docs: Path) -> str:
    """The link as it is if its target is within the site, or else its text with the path in the repository."""
    text, target = link.groups()
    path = (folder / target.partition("#")[0]).resolve()
    if "://" in target or path.is_relative_to(docs):
        return link[0]
    return f"{text} (`{path.relative_to(docs.parent)}`)"


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Adds the two pages to those of the folder."""
    with TemporaryDirectory() as folder:
        api = create_app(Settings(database=f"{folder}/empty.db")).openapi()
    files.append(File.generated(config, PAGE, content=page(typer.main.get_command(build()))))
    files.append(File.generated(config, ROUTES, content=routes(api)))
    return files


def routes(api: dict[str, Any]) -> str:
    """One section for each route: what it does, its parameters and the fields of its body."""
    sections = [
        "# HTTP routes\n\nMade from the OpenAPI of the server, which `/docs` of a running server shows with examples.\n"
    ]
    for path, methods in api["paths"].items():
        for method, route in methods.items():
            rows = [*parameters(route), *fields(route, api)]
            head = "| field | default | meaning |\n|---|---|---|\n" if rows else ""
            told = cell(route.get("description", "")).replace("``", "`")
            sections.append(f"## `{method.upper()} {path}`\n\n{route['summary']}. {told}\n\n{head}" + "".join(rows))
    return "\n".join(sections)


def parameters(route: dict[str, Any]) -> Iterator[str]:
    """A row for each parameter of the query."""
    for parameter in route.get("parameters", []):
        if parameter["in"] == "query":
            yield field(parameter["name"], parameter["schema"] | parameter, parameter.get("required", False))


def fields(route: dict[str, Any], api: dict[str, Any]) -> Iterator[str]:
    """A row for each field of the JSON body."""
    content = route.get("requestBody", {}).get("content", {}).get("application/json", {})
    name = content.get("schema", {}).get("$ref", "").rpartition("/")[2]
    body = api["components"]["schemas"].get(name, {})
    for key, schema in body.get("properties", {}).items():
        yield field(key, schema, key in body.get("required", []))


def field(name: str, schema: dict[str, Any], required: bool) -> str:
    default = "required" if required else f"`{json.dumps(schema.get('default'))}`"
    return f"| `{name}` | {default} | {cell(schema.get('description', '')).replace('``', '`')} |\n"


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
