"""From an empty server to a judged policy for one's own environment by the page alone."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest
from playwright.sync_api import Page, expect

from support.browser import serious
from support.server import running_server

Open = Callable[..., Page]
TUTORIAL = Path(__file__).parents[2] / "docs" / "tutorial.md"


@contextmanager
def running(folder: Path, *words: str) -> Iterator[None]:
    """A command of the program for the time of the context, as a person would start it and end it by Ctrl-C."""
    with (folder / f"{words[0]}.log").open("wb") as log:
        command = [sys.executable, "-m", "surrogym", *words]
        environment = os.environ | {"OMP_NUM_THREADS": "1"}
        process = subprocess.Popen(command, cwd=folder, stdout=log, stderr=log, env=environment)
    try:
        yield
    finally:
        process.send_signal(signal.SIGINT)
        process.wait(60)


@pytest.mark.e2e
@pytest.mark.timeout(1_800)
def test_the_dashboard_alone_suffices_from_registration_to_an_evaluated_policy(
    tmp_path: Path, open_page: Open, complaints: list[str]
):
    expect.set_options(timeout=600_000)
    (program,) = re.findall(
        r"```python\n(from surrogym_sampler.original import RealStep.*?)```", TUTORIAL.read_text(), re.S
    )
    (tmp_path / "cart.py").write_text(program)
    said = [sys.executable, "-c", "import cart; print(cart.Cart().spec().model_dump_json())"]
    spec = subprocess.run(said, cwd=tmp_path, capture_output=True, text=True, check=True).stdout
    with running_server(tmp_path) as server, ExitStack() as workers:
        common = ("cart", "--env", "cart:Cart", "--wait", "600", "--server", server.url)
        for command in ("sample", "work"):
            workers.enter_context(running(tmp_path, command, *common))
        page = open_page(f"{server.url}/#/register")
        page.get_by_label("or paste its text").fill(spec)
        page.get_by_label("Name of the surrogate").fill("cart")
        page.get_by_role("button", name="Check").click()
        page.get_by_role("button", name="Register cart").click()
        expect(page.locator(".title")).to_contain_text(re.compile("(not )?ready"))
        here = page.locator("#work")
        here.get_by_role("button", name="Start training").click()
        ended = here.get_by_role("list", name="Jobs that have ended").locator("li").first
        expect(ended).to_contain_text(re.compile("train, seed 0 done.*Promised"))
        expect(here.get_by_label("Policy", exact=True)).to_have_value("1")
        here.get_by_label("Real episodes").fill("50")
        here.get_by_label("Compare with").select_option("an action of zero")
        here.get_by_role("button", name="Evaluate").click()
        expect(ended).to_contain_text(
            re.compile("Promised .*; real mean return .* in 50 episodes: the promise was (kept|broken)")
        )
        expect(page.locator("#policies summary").first).to_contain_text("real mean return")
        assert serious(page) == []
    assert complaints == []
