"""A headless Chromium, and pages in it that remember what went wrong in them."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import pytest
from playwright.sync_api import Browser, Page

from support.browser import find_chromium, launched

Open = Callable[..., Page]


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    """One for a file: while Playwright lives, its event loop runs in this thread and ``asyncio.run`` refuses."""
    if find_chromium() is None:
        pytest.skip("Chromium is not on this machine, so the page is not tested. To test it: apt-get install chromium")
    with launched() as found:
        yield found


@pytest.fixture
def complaints() -> list[str]:
    """What the pages of a test wrote to the console as errors or warnings, or threw."""
    return []


@pytest.fixture
def open_page(browser: Browser, complaints: list[str]) -> Iterator[Open]:
    """Opens pages, each in a context of its own: ``open_page(url, width=390, scheme="dark")``."""
    contexts = []

    def open_one(url: str, width: int = 1280, height: int = 900, scheme: str = "light") -> Page:
        context = browser.new_context(viewport={"width": width, "height": height}, color_scheme=scheme)
        contexts.append(context)
        page = context.new_page()
        page.set_default_timeout(30_000)
        page.on("console", lambda m: complaints.append(m.text) if m.type in ("error", "warning") else None)
        page.on("pageerror", lambda error: complaints.append(str(error)))
        page.goto(url)
        return page

    yield open_one
    for context in contexts:
        context.close()
