"""The site builds without a warning, loads nothing from another host, and holds what is made from the code."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from support.commands import command_line
from surrogym_shared.wire import OpenSession

ROOT = Path(__file__).parents[2]
LOADED = re.compile(
    r"""<(?:script|img|iframe|source|video)\b[^>]*\bsrc="(?:https?:)?//[^"]*"|"""
    r"""<link\b(?=[^>]*rel="(?:stylesheet|preload|preconnect|icon)")[^>]*href="(?:https?:)?//[^"]*"|"""
    r"""url\(["']?(?:https?:)?//[^)]*\)"""
)
LINK = re.compile(r'href="([^"]*)"')


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--site-dir", str(folder)]
    environment = os.environ | {"NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return folder


def test_the_documentation_site_builds_with_every_page_in_its_navigation(site: Path) -> None:
    pages = {path.relative_to(ROOT / "docs").with_suffix(".html") for path in (ROOT / "docs").rglob("*.md")}
    built = {path.relative_to(site) for path in site.rglob("*.html")}
    assert pages <= built
    home = (site / "index.html").read_text(encoding="utf-8")
    assert [str(page) for page in pages if f'href="{page}"' not in home] == []


def test_the_site_shows_records_outside_of_it_as_paths_instead_of_links(site: Path) -> None:
    architecture = (site / "architecture.html").read_text(encoding="utf-8")
    assert "<code>lab/records/decisions/README.md</code>" in architecture
    outside = {
        str(page) for page in site.rglob("*.html") if "records/" in "".join(LINK.findall(page.read_text("utf-8")))
    }
    assert outside == set()


def test_the_documentation_site_loads_nothing_from_another_host(site: Path) -> None:
    pages = [*site.rglob("*.html"), *site.rglob("*.css")]
    found = {str(page.relative_to(site)): LOADED.findall(page.read_text(encoding="utf-8")) for page in pages}
    assert {page: loads for page, loads in found.items() if loads} == {}


def test_every_command_is_in_the_site_reference(site: Path) -> None:
    page = (site / "reference" / "commands.html").read_text(encoding="utf-8")
    names = [name for name, command in command_line().commands.items() if not command.hidden]
    assert [name for name in names if f"surrogym {name}" not in page] == []


def test_every_http_route_is_in_the_site_reference_with_its_parameters(site: Path) -> None:
    page = (site / "reference" / "http.html").read_text(encoding="utf-8")
    assert "POST /v1/surrogates/{name}/policies" in page
    fields = OpenSession.model_fields
    assert [name for name in fields if f"<code>{name}</code>" not in page] == []


def test_the_python_client_is_in_the_site_reference_with_its_docstrings(site: Path) -> None:
    page = (site / "reference" / "client.html").read_text(encoding="utf-8")
    assert "Vector environment of Stable-Baselines3 whose lanes are virtual environments of one surrogate" in page
    assert "surrogym_client.transport.Api.create_surrogate" in page
