"""Registering from the page: a specification is checked, shown and stored, and each wrong field is named."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path

import pytest
from playwright.sync_api import Page, expect

from support.browser import serious
from support.server import ServerProcess
from surrogym_client.original.classic import pendulum
from surrogym_client.transport import Api

Open = Callable[..., Page]


@pytest.fixture
def url(server_process: ServerProcess) -> str:
    expect.set_options(timeout=30_000)
    return server_process.url


def test_a_drafted_specification_is_shown_and_then_registered(
    url: str, open_page: Open, complaints: list[str], tmp_path: Path
):
    draft = {"real_steps": 400, "resets": 9, "found": ["theta turns"], "asked": ["is 8 the limit of speed?"]}
    file = tmp_path / "env.json"
    file.write_text(json.dumps({**draft, "specification": pendulum().model_dump(mode="json")}))
    page = open_page(f"{url}/#/register")
    page.get_by_label("Choose the file").set_input_files(file)
    page.get_by_label("Name of the surrogate").fill("by-page")
    page.get_by_role("button", name="Check").click()
    shown = page.get_by_role("region", name="by-page: the server would store this")
    expect(shown).to_contain_text("is 8 the limit of speed?")
    expect(shown.get_by_role("region", name="Coordinates")).to_contain_text(re.compile("speed.*−8.00 to 8.00"))
    expect(shown).to_contain_text(re.compile("budget30 real steps"))
    assert serious(page) == []
    with Api(url) as api:
        assert "by-page" not in [one.name for one in api.surrogates()]
        page.get_by_role("button", name="Register by-page").click()
        expect(page.locator(".title")).to_contain_text("collecting")
        assert api.surrogate("by-page").spec == pendulum()
        api.delete_surrogate("by-page")
    assert complaints == []


def test_each_wrong_field_is_named_with_what_came(url: str, open_page: Open):
    spec = pendulum().model_dump(mode="json")
    spec["coordinates"][1]["sampling"]["high"] = "fast"
    spec["speed_limit"] = 8
    page = open_page(f"{url}/#/register")
    page.get_by_label("or paste its text").fill(json.dumps(spec))
    page.get_by_role("button", name="Check").click()
    faults = page.get_by_role("region", name="Fields that can't be used").locator("tbody tr")
    expect(faults).to_have_count(2)
    expect(faults.nth(0)).to_contain_text(re.compile("coordinates.1.sampling.*high.*number.*'fast'"))
    expect(faults.nth(1)).to_contain_text(re.compile("speed_limit.*8"))
    expect(page.get_by_role("button", name=re.compile("^Register"))).to_have_count(0)
    assert serious(page) == []
    page.get_by_label("or paste its text").fill("{")
    page.get_by_role("button", name="Check").click()
    expect(page.get_by_role("alert").filter(has_text="Expected JSON")).to_be_visible()


def test_everything_shown_can_be_downloaded(
    pendulum_server: ServerProcess, url: str, open_page: Open, complaints: list[str], tmp_path: Path
):
    page = open_page(f"{url}/#/s/pendulum")
    part = page.locator("#downloads")
    expect(part.get_by_role("button", name="Newest model")).to_be_visible()
    for number, button in enumerate(part.get_by_role("button").all()):
        with page.expect_download() as downloading:
            button.click()
        assert downloading.value.suggested_filename.startswith("pendulum-")
        downloading.value.save_as(tmp_path / str(number))
        assert (tmp_path / str(number)).stat().st_size > 0
    with Api(url) as api:
        assert json.loads((tmp_path / "0").read_text()) == api.surrogate("pendulum").spec.model_dump(mode="json")
    assert (tmp_path / "1").read_text().count("\n") == 13  # a heading and twelve steps
    expect(part.get_by_role("alert")).to_be_hidden()
    assert complaints == []
