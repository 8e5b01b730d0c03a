"""The page follows a server: from nothing through real steps that land, a kill and a restart."""

from __future__ import annotations

import re
import signal
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Page, expect

from support.browser import serious
from support.server import RestartingServer
from surrogym_client.transport import Api
from surrogym_sampler.original.classic import pendulum
from surrogym_sampler.original.gymnasium import GymnasiumEnvironment
from surrogym_sampler.queries import Sampler, SamplerSettings

Open = Callable[..., Page]
TOKEN = "the-token-of-an-admin"
NETWORK = "Failed to load resource"  # the browser's own line about a refused token, or a server that is away


@pytest.fixture
def server(tmp_path: Path) -> Iterator[RestartingServer]:
    tokens = tmp_path / "tokens"
    tokens.write_text(f"{TOKEN}\n")
    running = RestartingServer(tmp_path, "--token-file", str(tokens))
    yield running
    if running.process.poll() is None:
        running.stop()


@pytest.mark.e2e
def test_the_dashboard_shows_new_real_steps_and_survives_a_server_restart(
    server: RestartingServer, open_page: Open, complaints: list[str]
):
    expect.set_options(timeout=60_000)
    page = open_page(server.url)
    unlock(page)
    expect(page.locator("main")).to_contain_text("No surrogate yet")
    assert serious(page) == []
    expect(page.locator("main pre")).to_contain_text(f"export SURROGYM_URL={server.url}")
    with Api(server.url, token=TOKEN) as api:
        spec = pendulum()
        api.create_surrogate("pendulum", spec)
        page.get_by_role("link", name=re.compile("^pendulum")).click()
        cost = page.locator(".fact .big").nth(2)
        expect(cost).to_have_text("0 real steps")
        sampler = Sampler(api, "pendulum", GymnasiumEnvironment(spec), SamplerSettings(name="worker", until_done=True))
        worker = threading.Thread(target=sampler.run)
        worker.start()
        expect(cost).to_have_text(re.compile("^[1-9]"))
        expect(page.locator(".title")).to_contain_text("1 sampler")
        worker.join(60)
        expect(cost).to_have_text(f"{api.surrogate('pendulum').ledger.total} real steps")
    expect(page.locator(".title")).to_contain_text("ready")
    expect(page.locator("#maps")).to_contain_text("of the tolerance on this cut")

    server.stop(signal.SIGKILL)
    expect(page.locator("#gone")).to_be_visible()
    expect(cost).to_contain_text("real steps")  # what it showed stays
    assert [fault for fault in serious(page) if "color-contrast" not in fault] == []  # what is old is pale on purpose
    server.start()
    expect(page.locator("#connection")).to_have_attribute("data-state", "live")
    expect(page.locator("#gone")).to_be_hidden()
    assert [said for said in complaints if NETWORK not in said] == []


def unlock(page: Page) -> None:
    """Give a wrong token, and then the right one."""
    field = page.get_by_label("Token", exact=True)
    expect(field).to_be_visible()
    assert serious(page) == []
    field.fill("not-the-token")
    field.press("Enter")
    expect(page.get_by_role("alert").filter(has_text="refused")).to_be_visible()
    field.fill(TOKEN)
    field.press("Enter")
    expect(page.locator("#connection")).to_have_attribute("data-state", "live")
