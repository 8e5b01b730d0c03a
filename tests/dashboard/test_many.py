"""The page of very many surrogates: a hundred at once, more where they are wished for."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from playwright.sync_api import Page, expect

from support.many import fill
from support.server import running_server

Open = Callable[..., Page]


def test_the_dashboard_lists_100_surrogates_and_more_on_demand(tmp_path: Path, open_page: Open, complaints: list[str]):
    fill(tmp_path / "surrogym.db", 104)
    with running_server(tmp_path) as server:
        page = open_page(server.url)
        rows, more = page.locator("a.row"), page.get_by_role("button", name="Show 100 more")
        expect(rows).to_have_count(100)
        more.click()
        expect(rows).to_have_count(104)
        expect(more).to_be_hidden()
    assert complaints == []


def test_unknown_dashboard_addresses_raise_no_script_error(tmp_path: Path, open_page: Open):
    with running_server(tmp_path) as server:
        page = open_page(server.url)
        thrown: list[str] = []
        page.on("pageerror", lambda error: thrown.append(str(error)))
        for address, words in (
            ("#/s/unknown", "no surrogate of this name"),
            ("#/compare/unknown", "Compare"),
            ("#/s/%E0%A4%A", "no surrogate"),
        ):
            page.goto(f"{server.url}/{address}")
            expect(page.locator("main")).to_contain_text(words)
        page.goto(f"{server.url}/#/%E0%A4%A")
        expect(page.locator("main")).to_contain_text("Register")
        page.wait_for_timeout(200)
    assert thrown == []
