"""The pages about HTTP are true: their curl lines, sent in their order to a real server, get what they promise."""

from __future__ import annotations

import itertools
import re
import shlex
import string
from pathlib import Path
from typing import Any

import httpx

from support.server import ServerProcess
from surrogym_shared.codes import STATUS

DOCS = Path(__file__).parents[2] / "docs"
PAGE = "".join((DOCS / page).read_text(encoding="utf-8") for page in ("http-api.md", "reference/stream.md"))
BLOCKS = re.findall(r"```console\n(.*?)```", PAGE, re.DOTALL)


def requests() -> list[str]:
    return re.findall(r"^curl .*?(?=^curl |\Z)", "".join(BLOCKS), re.DOTALL | re.MULTILINE)


class Shell:
    """Runs curl lines as a shell would, with httpx in the place of curl; remembers what the page gives names to."""

    def __init__(self, client: httpx.Client, folder: Path) -> None:
        self.client, self.folder, self.names = client, folder, {"URL": str(client.base_url).rstrip("/")}

    def run(self, line: str) -> httpx.Response:
        words = shlex.split(string.Template(line).substitute(self.names))[1:]
        options = {name: value for name, value in itertools.pairwise(words) if name.startswith("-")}
        (url,) = (word for word in words if word.startswith("http"))
        headers = dict([options["-H"].split(": ", 1)]) if "-H" in options else {}
        reply = self.client.request(options.get("-X", "GET"), url, headers=headers, content=self._body(options))
        if "-o" in options:
            (self.folder / options["-o"]).write_bytes(reply.content)
        elif reply.headers.get("content-type") == "application/json":
            self._remember(reply.json())
        return reply

    def _body(self, options: dict[str, str]) -> bytes | None:
        if "--data-binary" in options:
            return (self.folder / options["--data-binary"].removeprefix("@")).read_bytes()
        return options["-d"].encode() if "-d" in options else None

    def _remember(self, reply: Any) -> None:
        if "seq" in reply and "id" in reply:
            self.names["SESSION"] = reply["id"]
        match reply.get("queries"):
            case [{"id": query, "lease_token": lease}, *_]:
                self.names |= {"QUERY": str(query), "LEASE": lease}


def test_every_curl_command_of_the_http_pages_works_in_order(server: ServerProcess, tmp_path: Path) -> None:
    with httpx.Client(base_url=server.url, timeout=150) as client:
        shell = Shell(client, tmp_path)
        replies = [(line, shell.run(line)) for line in requests()]
    assert [(line, reply.text) for line, reply in replies if not reply.is_success] == []
    steps = [reply.text for line, reply in replies if "/step " in line]
    assert steps[0] == steps[1]


def test_the_http_page_lists_every_error_code_with_its_status() -> None:
    rows = re.findall(r"^\| ([\d, ]+) \| (.*) \|$", PAGE, re.MULTILINE)
    told = {
        (int(status), code) for statuses, codes in rows for status in statuses.split(", ") for code in _words(codes)
    }
    assert {(status, code.value) for code, status in STATUS.items()} <= told
    assert {code for _, code in told} == {code.value for code in STATUS}


def _words(cell: str) -> list[str]:
    return re.findall(r"`(\w+)`", cell)
