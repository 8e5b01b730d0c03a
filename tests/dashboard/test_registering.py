"""Registering from the page: a specification is checked, shown and stored, and each wrong field is named."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Page, expect

from support import limited, reactor
from support.browser import serious
from support.controllers import network
from support.server import ServerProcess
from surrogym_client.transport import Api
from surrogym_sampler.original.classic import pendulum
from surrogym_shared import wire
from surrogym_shared.wire import NewSample

Open = Callable[..., Page]


@pytest.fixture
def url(server_process: ServerProcess) -> str:
    expect.set_options(timeout=30_000)
    return server_process.url


def test_a_drafted_specification_can_be_reviewed_and_registered_on_the_dashboard(
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
    expect(shown).to_contain_text(re.compile("success.*cos.*theta"))
    assert serious(page) == []
    with Api(url) as api:
        assert "by-page" not in [one.name for one in api.surrogates()]
        page.get_by_role("button", name="Register by-page").click()
        expect(page.locator(".title")).to_contain_text("collecting")
        assert api.surrogate("by-page").spec == pendulum()
        api.delete_surrogate("by-page")
    assert complaints == []


def test_the_dashboard_shows_declared_limits_and_counts_real_steps_beyond_them(
    url: str, open_page: Open, complaints: list[str], tmp_path: Path
):
    page = open_page(f"{url}/#/register")
    page.get_by_label("or paste its text").fill(limited.SPEC.model_dump_json())
    page.get_by_label("Name of the surrogate").fill("limited")
    page.get_by_role("button", name="Check", exact=True).click()
    shown = page.get_by_role("region", name="limited: the server would store this")
    expect(shown.get_by_role("region", name="Limits", exact=True)).to_contain_text(
        re.compile(r"rail.*x \+ 0\.300 v.*−1\.00 to 1\.00.*0\.400")
    )
    expect(shown).to_contain_text(re.compile(r"fallback near a limit.*x \+ .*v"))
    expect(shown).to_contain_text(re.compile("episodes that may leave a limit.*1 %"))
    with Api(url) as api:
        page.get_by_role("button", name="Register limited").click()
        expect(page.locator(".title")).to_contain_text("collecting")
        path = [[0.0, 0.0], [0.9, 0.2], [1.1, 0.2]]
        steps = [
            NewSample(coordinates=at, action=[1.0], next_coordinates=after, reward=0.0, terminated=False)
            for at, after in pairwise(path)
        ]
        api.add_samples("limited", "person", steps)
        expect(page.locator("#ledger")).to_contain_text("limit rail: 1 of 2 real steps beyond it, least room -0.16")
        expect(page.locator("#ledger")).to_contain_text("the fallback was due after 2 of 2 real steps")
        assert api.limits("limited")[0] in page.locator("#ledger").text_content()
        counts = wire.LimitCounts(violations=2, fallbacks=9, fallback_episodes=4)
        api.report_steps("limited", 400, episodes=10, limits=counts)
        expect(page.locator("#ledger")).to_contain_text("evaluations: 2 of 10 episodes left a limit")
        file = network(tmp_path, limited.SPEC, (4,)).read_bytes()
        api.policies.push("limited", wire.PushedCard(), [], "zip", file)
        episodes: dict[str, Any] = {"returns": [1.0] * 10, "lengths": [40] * 10, "first_seed": 0, "limits": counts}
        api.policies.evaluate("limited", 1, wire.AddEvaluation(**episodes, idempotency_key="a"))
        summary = page.locator("#policies summary").first
        expect(summary).to_contain_text(
            "Limits: 2 of 10 episodes left a limit (95 % interval 2.5 to 56 %, allowed 1 %)"
        )
        expect(summary).to_contain_text("Not trusted: the latest evaluation did not keep the limits")
        api.delete_surrogate("limited")
    assert complaints == []


def test_the_dashboard_names_each_invalid_specification_field_with_its_value(url: str, open_page: Open):
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


def test_the_example_specification_of_the_dashboard_can_be_registered_unchanged(
    url: str, open_page: Open, complaints: list[str]
):
    page = open_page(f"{url}/#/register")
    page.get_by_role("button", name=re.compile("^Insert an example")).click()
    page.get_by_role("button", name="Check", exact=True).click()
    page.get_by_role("button", name="Register cart").click()
    expect(page.locator(".title")).to_contain_text("collecting")
    with Api(url) as api:
        assert api.surrogate("cart").spec.coordinate_names == ("x", "speed")
        api.delete_surrogate("cart")
    assert complaints == []


def test_every_download_button_of_the_dashboard_delivers_its_file(
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


def test_a_log_uploaded_on_the_dashboard_becomes_a_surrogate_with_a_model(
    url: str, open_page: Open, complaints: list[str], tmp_path: Path
):
    file = reactor.log(runs=3, length=20).write(tmp_path / "reactor.csv")
    lines = file.read_text().splitlines()
    file.write_text("\n".join([*lines, lines[1], ""]))  # a row that repeats another
    page = open_page(f"{url}/#/register")
    page.get_by_text("Start from a log instead").click()
    page.get_by_label("Log as CSV").set_input_files(file)
    page.get_by_role("button", name="Check the log").click()
    expect(page.get_by_text("usable steps of 61 rows")).to_be_visible()
    expect(page.get_by_role("region", name="Rows that can't be used")).to_contain_text("repeats line 2")
    assert serious(page) == []
    page.get_by_role("button", name="Register reactor and store its log").click()
    expect(page.locator(".facts")).to_contain_text("60 more came from a log")
    expect(page.locator(".title")).to_contain_text("from a log", timeout=60_000)
    with Api(url) as api:
        assert api.surrogate("reactor").ledger.logged == 60
        api.delete_surrogate("reactor")
    assert complaints == []


def test_a_log_with_other_column_names_is_imported_on_the_dashboard_by_a_mapping(
    url: str, open_page: Open, tmp_path: Path
):
    file = tmp_path / "plant.csv"
    file.write_text("angle,rate,motor,profit\n0.1,0.0,1.5,-1\n0.115,0.3,0.5,-1\n0.13,9.9,0.5,-1\n0.14,0.1,0.5,-1\n")
    with Api(url) as api:
        api.create_surrogate("plant", pendulum())
        page = open_page(f"{url}/#/s/plant")
        part = page.locator("#log")
        part.get_by_label("Log as CSV").set_input_files(file)
        part.get_by_role("button", name="Check the log").click()
        expect(part.get_by_role("alert")).to_contain_text("expected a column of the action")
        chosen = {"angle": "state theta", "rate": "state speed", "motor": "action", "profit": "reward"}
        for column, role in chosen.items():
            part.get_by_label(column, exact=True).select_option(role)
        mapping = {"state": {"theta": "angle", "speed": "rate"}, "action": {"0": "motor"}, "reward": "profit"}
        text = part.get_by_label("mapping as JSON")
        assert json.loads(text.input_value()) == mapping
        part.get_by_role("button", name="Check the log").click()
        expect(part.get_by_role("region", name="Rows that can't be used")).to_contain_text("rate: expected a value in")
        assert serious(page) == []
        assert api.surrogate("plant").ledger.logged == 0
        part.get_by_role("button", name="Store 1 step").click()
        expect(part.get_by_role("status")).to_contain_text("1 new logged step")
        assert api.surrogate("plant").ledger.logged == 1
        api.delete_surrogate("plant")


def test_select_fields_and_text_of_a_column_mapping_stay_in_sync(url: str, open_page: Open, tmp_path: Path):
    file = tmp_path / "plant.csv"
    file.write_text('batch;"LT;101";LT-next;valve\n1;0.1;0.2;0.5\n1;0.2;0.3;0.5\n')
    page = open_page(f"{url}/#/register")
    page.get_by_text("Start from a log instead").click()
    page.get_by_label("Log as CSV").set_input_files(file)
    page.get_by_text("The columns have other names").click()
    text = page.get_by_label("mapping as JSON")
    text.fill(json.dumps({"state": {"level": "LT;101"}, "action": {"opening": "valve"}, "limits": {"level": [0, 1]}}))
    assert page.get_by_label("LT;101", exact=True).input_value() == "state"
    assert page.get_by_label("valve", exact=True).input_value() == "action:0"
    page.get_by_label("LT-next", exact=True).select_option("next state of LT;101")
    page.get_by_label("batch", exact=True).select_option("reward")
    page.get_by_label("batch", exact=True).select_option("number of the episode")
    assert json.loads(text.input_value()) == {
        "state": {"level": "LT;101"},
        "action": {"opening": "valve"},
        "limits": {"level": [0, 1]},
        "next": {"level": "LT-next"},
        "episode": "batch",
    }
    text.fill("{")
    assert page.get_by_label("batch", exact=True).input_value() == "episode"
    assert serious(page) == []
