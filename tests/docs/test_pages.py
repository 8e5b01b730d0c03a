"""Every page is true to the tree: links lead somewhere, commands, options and targets exist, imports work."""

from __future__ import annotations

import ast
import importlib
import re
import shlex
from collections.abc import Iterator
from pathlib import Path

import pytest

from support.commands import command_line, options, parse

ROOT = Path(__file__).parents[2]
PAGES = sorted(
    [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs").rglob("*.md"), *(ROOT / "lab").rglob("*.md")]
)
NAMES = [str(page.relative_to(ROOT)) for page in PAGES]
SHELLS = "console|bash|sh|shell"
each_page = pytest.mark.parametrize("page", PAGES, ids=NAMES)


def fenced(text: str, languages: str) -> str:
    return "\n".join(re.findall(rf"^```(?:{languages})\n(.*?)^```", text, re.DOTALL | re.MULTILINE))


def commands(page: Path, program: str) -> Iterator[list[str]]:
    """What a page tells people to type: lines of shell blocks, and code within a sentence."""
    text = page.read_text(encoding="utf-8")
    shell = fenced(text, SHELLS).replace("\\\n", " ")
    lines = re.findall(rf"^(?:\$ )?(?:\w+=\S+ )*({program} .*)$", shell, re.MULTILINE)
    inline = re.findall(rf"`({program} [^`]+)`", re.sub(r"^```.*?^```", "", text, flags=re.DOTALL | re.MULTILINE))
    for line in (*lines, *inline):
        words = shlex.split(line.partition(" > ")[0], comments=True)
        yield words[1:-1] if words[-1] == "&" else words[1:]


def anchors(page: Path) -> set[str]:
    headings = re.findall(r"^#+ (.*)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@each_page
def test_every_documentation_link_has_an_existing_target(page: Path) -> None:
    broken = []
    for link in re.findall(r"\]\(([^)\s]+)\)", page.read_text(encoding="utf-8")):
        if re.match(r"\w+:", link):
            continue
        path, _, anchor = link.partition("#")
        target = (page.parent / path) if path else page
        if not target.exists() or (anchor and anchor not in anchors(target)):
            broken.append(link)
    assert broken == []


def test_every_page_of_the_site_is_in_its_navigation() -> None:
    listed = re.findall(
        r"^ +- (?:[^:\n]+: )?(\S+\.md)$", (ROOT / "mkdocs.yml").read_text(encoding="utf-8"), re.MULTILINE
    )
    assert {str(page.relative_to(ROOT / "docs")) for page in (ROOT / "docs").rglob("*.md")} <= {*listed}


@each_page
def test_every_test_file_named_in_the_documentation_exists(page: Path) -> None:
    named = re.findall(
        r"(?<![\w/])(?:lab/)?(?:tests|benchmarks)/[\w/-]+(?:\.(?:py|json|toml))?", page.read_text(encoding="utf-8")
    )
    assert [name for name in named if not (ROOT / name).exists()] == []


def named(words: list[str]) -> list[str]:
    """The words that name the command, two where it is one of a group."""
    group = getattr(command_line().commands[words[0]], "commands", {})
    return words[:2] if words[1] in group else words[:1]


@each_page
def test_every_documented_command_exists_with_its_options(page: Path) -> None:
    for words in commands(page, "surrogym"):
        if words[0].startswith("--"):
            assert words[0] in options()
        elif len(words) == 1 or words[-1] == "--help":
            assert words[0] in command_line().commands
        elif any(word.isupper() for word in words):  # stands for what a person fills in
            assert {word for word in words if word.startswith("--")} <= options(*named(words))
        else:
            parse(words)


@each_page
def test_every_documented_make_target_exists(page: Path) -> None:
    targets = re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)
    named = {words[0] for words in commands(page, "make")}
    assert named <= set(targets)


@each_page
def test_documented_python_code_parses_and_its_imports_work(page: Path) -> None:
    for block in re.findall(r"^```python\n(.*?)^```", page.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE):
        for node in ast.walk(ast.parse(block)):
            if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith("surrogym_"):
                module = importlib.import_module(node.module)
                assert [alias.name for alias in node.names if not hasattr(module, alias.name)] == []


@each_page
def test_rows_of_documentation_tables_have_as_many_cells_as_their_header(page: Path) -> None:
    """No row is cut off or runs into the text behind it."""
    text = re.sub(r"^```.*?^```|`[^`\n]*`", "", page.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)
    for table in re.findall(r"(?:^\|.*\n)+", text, re.MULTILINE):
        assert len({line.replace(r"\|", "").rstrip().strip("|").count("|") for line in table.splitlines()}) == 1, table
        assert all(line.rstrip().endswith("|") for line in table.splitlines()), table


def test_the_documentation_tests_find_pages_to_check() -> None:
    assert {"README.md", "docs/architecture.md", "docs/http-api.md", "docs/glossary.md"} <= set(NAMES)
