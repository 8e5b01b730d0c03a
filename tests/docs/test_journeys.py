"""Pages are followed from top to bottom as a reader would: programs are saved or run, commands typed, in their order.

Long work is made short (``SHORTER``), and what another test runs, or what belongs to another machine, is left out
(``ELSEWHERE``). One page is followed here, all of them with DOCS=full, which is in ``make test-all``.
"""

from __future__ import annotations

import itertools
import os
import re
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import Literal

import pytest

from support.examples import EXAMPLES, ROOT, run
from support.server import ServerProcess, running_server
from support.teaching import teach
from surrogym_client.transport import Api
from surrogym_sampler.original.classic import pendulum

OWN_LINES = 30  # of an environment, blank ones left out
PRINTED_URL = "http://127.0.0.1:8000"
PAGES = ["docs/tutorial.md"]
ALL_PAGES = [
    "README.md",
    "docs/how-to/files-and-terminal.md",
    "docs/how-to/in-process.md",
    "docs/how-to/no-teleport.md",
    "docs/how-to/own-environment.md",
    "docs/how-to/page.md",
    "docs/how-to/policy-search.md",
    "docs/how-to/rewards-and-terminations.md",
    "docs/how-to/trainers.md",
    "docs/how-to/variants.md",
]
SHORTER = {
    "sample": ["--until-done"],
    "register": ["--budget", "12"],
    "train": ["--steps", "512", "--num-envs", "16"],
    "evaluate": ["--episodes", "1"],
}
IN_PROGRAMS = {"0_000": "00", "5_000": "100", "num_envs=16": "num_envs=2"}
READERS_FUNCTIONS = (
    "read_sensors, send = lambda: [1.0, 0.0, 0.0], lambda action: None\n"  # that files-and-terminal.md leaves to them
)
ELSEWHERE = {
    "make": "tests/demo and the Makefile itself",
    "docker": "tests/docker",
    "export": "a setting of the shell",
    "for": "a loop of the shell, whose commands are tested elsewhere",
    "done": "a loop of the shell, whose commands are tested elsewhere",
    ".": "a setting of the shell",
    "pip": "tests/packaging",
    "tensorboard": "a page that stays open",
    "surrogym serve": "a server of this test runs already",
    "surrogym demo": "tests/demo",
    "surrogym work": "tests/work",
    "surrogym jobs": "tests/cli/test_jobs.py",
    "python -m surrogym_lab": "lab/tests/test_commands.py",
}
ELSEWHERE_WITH = {  # a word anywhere in the line
    "--watch": "tests/cli/test_status.py",
    "--install-completion": "tests/cli/test_completion.py",
    "--improve": "tests/training/test_closed_loop.py",
    "Pusher-v5": "tests/cli/test_learning.py, as these rounds take an hour",
    "pusher": "tests/cli/test_learning.py, as these rounds take an hour",
    "--learn-all": "tests/cli/test_learning.py, as these rounds take an hour",
    "wandb": "tests/examples/test_trackers.py",
    "mlflow": "tests/examples/test_trackers.py",
}
OTHERWISE = {
    "docs/how-to/policies.md": "tests/cli/test_commands.py, as it needs three versions; test_how_to.py films",
    "docs/how-to/backup.md": "tests/server starts on databases and copies of them",
    "docs/http-api.md": "test_http_api.py sends its requests without curl",
    "docs/reference/stream.md": "test_http_api.py sends its requests without curl",
    "docs/how-to/containers.md": "tests/docker reads it; no container engine is needed",
    "docs/how-to/operate.md": "tests/server and tests/security start servers with these settings",
    "docs/how-to/plugins.md": "tests/plugins installs the package and compares its class with the page",
    "docs/how-to/logs.md": "tests/logs runs its commands",
    "docs/how-to/environments-by-name.md": "tests/original and tests/cli/test_describe.py run its commands",
    "docs/how-to/fmus.md": "tests/original/test_fmus.py builds its FMUs, tests/deployment writes a twin",
    "docs/how-to/executables.md": "tests/original/test_executables.py runs its program",
    "docs/how-to/deploy.md": "tests/deployment runs its commands and compiles its controllers",
    "docs/how-to/drift.md": "tests/cli/test_watch.py and test_renew.py run the commands",
    "docs/how-to/controller-c.md": "tests/deployment compiles its program and runs the vectors",
    "docs/how-to/priors.md": "tests/docs/test_how_to.py runs its programs, tests/cli/test_prior.py the command",
    "docs/how-to/contacts.md": "tests/docs/test_how_to.py runs its program without the training, which takes minutes",
    "docs/how-to/history.md": "tests/docs/test_how_to.py runs its programs",
    "docs/how-to/limits.md": "tests/docs/test_how_to.py runs its program",
    "docs/how-to/planner.md": "tests/plugins/test_policy_searches.py makes and loads a planner",
    "docs/how-to/trust.md": "tests/training/test_handover.py audits beside a sampler that stays",
}
BLOCK = re.compile(r"^```(python|console)\n(.*?)^```$", re.DOTALL | re.MULTILINE)
SAVED = re.compile(r"[Ss]ave\s+(?:this|it)\s+as\s+`(\S+\.py)`")


@pytest.mark.timeout(900)  # on a machine that others use as well
@pytest.mark.parametrize("page", PAGES + (ALL_PAGES if os.environ.get("DOCS") == "full" else []))
def test_all_commands_and_programs_of_a_documentation_page_run_in_order(page: str, tmp_path: Path) -> None:
    server_folder, folder = tmp_path / "server", tmp_path / "reader"
    server_folder.mkdir()
    folder.mkdir()
    (folder / "examples").symlink_to(EXAMPLES)
    with running_server(server_folder) as server:
        for kind, content in steps((ROOT / page).read_text(encoding="utf-8")):
            follow(server, folder, kind, content)


def steps(text: str) -> Iterator[tuple[Literal["file", "program", "command"], str]]:
    """What a page has its reader do, in order; a file begins with the line of its name."""
    first_command = re.search(r"surrogym register \S+ --name pendulum", text)
    if first_command is None and "pendulum" in text:
        yield "file", "pendulum"
    for block in BLOCK.finditer(text):
        language, code = block.groups()
        saved = SAVED.search(text[: block.start()].rstrip().rpartition("\n\n")[2])
        if language == "console":
            yield from (("command", line) for line in code.replace("\\\n", " ").splitlines() if line.strip())
        elif saved is not None:
            yield "file", f"{saved[1]}\n{code}"
        else:
            yield "program", code


def follow(server: ServerProcess, folder: Path, kind: str, content: str) -> None:
    if kind == "file" and content == "pendulum":  # the page supposes that it is there
        with Api(server.url) as api:
            teach(api, "pendulum", pendulum(), queries=6)
    elif kind == "file":
        name, _, code = content.partition("\n")
        (folder / name).write_text(code, encoding="utf-8")
    elif kind == "program":
        for long, short in IN_PROGRAMS.items():
            content = content.replace(long, short)
        content = READERS_FUNCTIONS + content if "read_sensors()" in content else content
        run(server, folder, "-c", content.replace(PRINTED_URL, server.url))
    elif (words := shortened(shlex.split(content, comments=True))) is not None:
        run(server, folder, *words)


def shortened(words: list[str]) -> list[str] | None:
    """The arguments of Python that a line of a shell comes to, made short; None where it is run elsewhere."""
    words = [*itertools.dropwhile(lambda word: re.match(r"[A-Z_]+=", word), words)]
    if not words or {words[0], " ".join(words[:2])} & ELSEWHERE.keys() or ELSEWHERE_WITH.keys() & set(words):
        return None
    if words[0] == "python":
        return [*words[1:], *(["--steps", "4096"] if words[1].startswith("train") else [])]
    assert words[0] == "surrogym", f"a page has people type {words[0]!r}, which nothing runs"
    more = SHORTER.get(words[1], []) if not {"--help", "planner"} & {*words} else []  # a planner is not trained
    return ["-m", "surrogym", *words[1:], *more]


def test_every_documentation_page_with_commands_is_run_by_a_test() -> None:
    pages = [ROOT / "README.md", *(ROOT / "docs").rglob("*.md")]
    found = {
        str(page.relative_to(ROOT)) for page in pages if re.search(r"^```(?!json|text|$)\S", page.read_text(), re.M)
    }
    assert found == {*PAGES, *ALL_PAGES, *OTHERWISE}


def test_the_user_defined_environment_of_the_tutorial_has_less_than_thirty_lines() -> None:
    text = (ROOT / "docs" / "tutorial.md").read_text(encoding="utf-8")
    (own,) = [content for kind, content in steps(text) if kind == "file" and content.startswith("cart.py\n")]
    assert len([line for line in own.splitlines()[1:] if line]) < OWN_LINES
