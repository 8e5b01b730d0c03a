"""The page for people who run a server lists every setting of the code, with its option and its default."""

from __future__ import annotations

import inspect
import re
from pathlib import Path
from typing import Any

from surrogym_server.cli.serve import serve
from surrogym_server.settings import PREFIX, Settings

PAGE = Path(__file__).parents[2] / "docs" / "reference" / "server.md"
DOCS = PAGE.parents[1]
ROW = re.compile(r"^\| `(SURROGYM_\w+)` \| (none|`--[\w-]+`) \| (\S+) \| .+ \|$", re.MULTILINE)
NOT_SETTINGS = {  # read by a client, by the compose file, or elsewhere in the server
    *("SURROGYM_URL", "SURROGYM_TOKEN", "SURROGYM_COMPILED"),
}


def shown(default: Any) -> str:
    if default is None or default == {}:
        return "none"
    return f"{default:g}" if isinstance(default, float) else str(default).lower()


def test_the_documented_table_of_server_settings_equals_the_code() -> None:
    options = inspect.signature(serve).parameters
    wanted = {
        PREFIX + name.upper(): (
            f"`--{name.replace('_', '-')}`" if name in options else "none",
            shown(field.get_default(call_default_factory=True)),
        )
        for name, field in Settings.model_fields.items()
    }
    rows = ROW.findall(PAGE.read_text(encoding="utf-8"))
    assert {name: (option, default) for name, option, default in rows} == wanted
    assert len(rows) == len(wanted)


def test_documentation_pages_name_only_existing_server_settings() -> None:
    known = {PREFIX + name.upper() for name in Settings.model_fields} | NOT_SETTINGS
    pages = DOCS.rglob("*.md")
    named = {name for page in pages for name in re.findall(r"\bSURROGYM_[A-Z_]*[A-Z]\b", page.read_text("utf-8"))}
    assert named - known == set()
