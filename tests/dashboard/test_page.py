"""The page in a real browser: complete, without a complaint, by keyboard, on a phone, and behind its content policy."""

from __future__ import annotations

import re
from collections.abc import Callable

import httpx
import pytest
from playwright.sync_api import Page, expect

from support.dirty import learned
from support.hinge import hinge_spec, sent
from support.server import ServerProcess
from surrogym_client.surrogates.transfer import export_surrogate
from surrogym_client.surrogates.waiting import wait_for_model
from surrogym_client.transport import Api
from surrogym_client.transport.priors import PriorCalls
from surrogym_sampler.original.classic import pendulum
from surrogym_shared.spec import (
    BoxAction,
    Coordinate,
    EnvironmentSpec,
    ObservationEntry,
    Term,
    Uniform,
)
from surrogym_shared.wire import NewSample

Open = Callable[..., Page]
PARTS = (
    "Policies",
    "Train and evaluate",
    "Learning",
    "Maps",
    "Probe",
    "Sessions",
    "Queue",
    "Ledger",
    "Steer",
    "Downloads",
    "Log",
    "Model versions",
)


@pytest.fixture
def url(pendulum_server: ServerProcess) -> str:
    expect.set_options(timeout=30_000)
    return pendulum_server.url


def opened(page: Page) -> Page:
    """The page once all that it asks for has come."""
    expect(page.locator(".episodes canvas")).to_have_count(3)
    expect(page.locator("#maps")).to_contain_text("of the tolerance on this cut")
    expect(page.locator(".facts")).to_contain_text("Least certain near")
    return page


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_the_dashboard_shows_a_surrogate_without_browser_errors(
    url: str, open_page: Open, complaints: list[str], scheme: str
):
    requested: list[str] = []
    page = open_page("about:blank", scheme=scheme)
    page.on("request", lambda request: requested.append(request.url))
    page.goto(f"{url}/#/s/pendulum")
    opened(page)
    headings = page.locator("section h2").all_text_contents()
    assert set(headings) == set(PARTS)
    expect(page.locator(".facts")).to_contain_text("12 real steps")
    assert page.locator("#learning canvas").count() == 2  # one axis of values each
    expect(page.locator("#learning .u-legend").last).to_contain_text(
        re.compile(r"speed\S+reward\S")
    )  # values without a mouse
    expect(page.locator("#queue tbody tr")).to_have_count(12)
    page.locator(".model summary").first.click()
    expect(page.locator(".model").first).to_contain_text("lengthscale")
    assert {re.match(r"https?://[^/]+", address)[0] for address in requested} == {url}
    assert complaints == []


def test_the_dashboard_names_the_dirt_of_a_machine(url: str, open_page: Open, complaints: list[str]):
    with Api(url) as api:
        learned(api, "furuta-with-dirt", "--seed", "1")
        (first, *_) = api.dirt("furuta-with-dirt")
    page = open_page(f"{url}/#/s/furuta-with-dirt")
    expect(page.locator(".facts")).to_contain_text(f"{first.name}: {first.said}")
    assert complaints == []


def test_the_dashboard_shows_where_a_model_of_twelve_coordinates_is_unsure(
    url: str, open_page: Open, complaints: list[str]
):
    names = [f"mass{i}" for i in range(12)]
    ranges = {name: Uniform(low=-1 / 3, high=1 / 3) for name in names}
    spec = EnvironmentSpec(
        environment="masses",
        coordinates=tuple(Coordinate(name=name, sampling=ranges[name]) for name in names),
        observation=tuple(ObservationEntry(name=name, term=Term.linear(**{name: 1})) for name in names),
        action=BoxAction(low=(-1,), high=(1,)),
        start=ranges,
        time_limit=10,
        design={"initial": 14, "budget": 14},
    )
    with Api(url) as api:
        api.create_surrogate("masses", spec)
        for query in api.claim("masses", "worker", max_queries=14).queries:
            q, (u,) = query.coordinates, query.action
            after = [0.9 * one + 0.1 * u for one in q]
            answer = {
                "coordinates": q,
                "action": [u],
                "next_coordinates": after,
                "reward": -(after[0] ** 2),
                "terminated": False,
            }
            api.add_samples("masses", "worker", [NewSample(query_id=query.id, lease_token=query.lease_token, **answer)])
    page = open_page(f"{url}/#/s/masses")
    expect(page.locator(".facts")).to_contain_text("of 768 points")
    expect(page.locator(".facts")).to_contain_text("Least certain near")
    assert complaints == []


def test_the_dashboard_shows_a_prior_and_the_outputs_that_use_it(url: str, open_page: Open, complaints: list[str]):
    with Api(url) as api:
        for name in ("hinge", "hinge-of-last-year"):
            api.create_surrogate(name, hinge_spec(design={"budget": 0}))
            sent(api, name, 12)
            wait_for_model(api, name, 60)
        page = open_page(f"{url}/#/s/hinge")
        expect(page.locator(".facts")).to_contain_text("What it cost")
        expect(page.locator(".facts")).not_to_contain_text("What was known")
        PriorCalls(api.connection).put("hinge", export_surrogate(api, "hinge-of-last-year").to_bytes())
    expect(page.locator(".facts")).to_contain_text("Prior: hinge-of-last-year")
    expect(page.locator(".facts")).to_contain_text("Outputs that use it: angle")
    assert complaints == []


def test_the_dashboards_content_security_policy_blocks_other_origins_and_inline_code(url: str):
    reply = httpx.get(url)
    policy = reply.headers["content-security-policy"]
    assert "default-src 'none'" in policy
    assert "unsafe" not in policy
    assert not re.search(r"<script(?![^>]*src=)|style=|\son\w+=", reply.text)


def test_clicking_on_a_dashboard_map_selects_the_predicted_point(url: str, open_page: Open):
    page = opened(open_page(f"{url}/#/s/pendulum"))
    canvas = page.locator(".heat canvas").first
    box = canvas.bounding_box()
    assert box is not None
    canvas.click(position={"x": box["width"] * 0.8, "y": box["height"] * 0.3})
    shown = [float(page.get_by_label(f"{name}, as a number").input_value()) for name in ("theta", "speed")]
    assert shown[0] > 1
    assert shown[1] > 1
    with Api(url) as api:
        said = api.predict("pendulum", [shown], [[0.0]])
    row = page.locator("#probe tbody tr").nth(1).locator("td").nth(2)
    expect(row).to_have_text(re.compile(f"^{said.next_coordinates[0][1]:.1f}"))


def test_a_surrogate_and_its_predicted_point_can_be_selected_by_keyboard(url: str, open_page: Open):
    page = open_page(url)
    row = page.get_by_role("link", name=re.compile("^pendulum"))
    expect(row).to_be_visible()
    for _ in range(30):
        page.keyboard.press("Tab")
        if row.evaluate("element => element === document.activeElement"):
            break
    page.keyboard.press("Enter")
    opened(page)
    canvas = page.locator(".heat canvas").first
    canvas.focus()
    page.keyboard.press("ArrowRight")
    page.keyboard.press("Shift+ArrowUp")
    assert float(page.get_by_label("theta, as a number").input_value()) > 0
    assert float(page.get_by_label("speed, as a number").input_value()) > 0
    assert "Arrow keys" in (canvas.get_attribute("aria-label") or "")


FOCUSABLE = """() => [...document.querySelectorAll("a[href], button, input, select, summary, [tabindex='0']")]
    .filter((element) => !element.matches(":disabled") && element.checkVisibility())"""


def test_every_dashboard_control_is_reachable_with_the_tab_key(url: str, open_page: Open):
    page = opened(open_page(f"{url}/#/s/pendulum"))
    page.evaluate(f"window.wanted = new Set(({FOCUSABLE})())")
    for _ in range(page.evaluate("wanted.size") + 1):
        page.keyboard.press("Tab")
        page.evaluate("wanted.delete(document.activeElement)")
    missed = "[...wanted].filter((element) => element.isConnected).map((element) => element.outerHTML)"
    assert page.evaluate(missed) == []
    page.get_by_role("navigation").get_by_role("link", name="Queue").press("Enter")
    page.keyboard.press("Tab")
    expect(page.get_by_label("queries to show")).to_be_focused()


def test_the_dashboard_queue_shows_sampler_and_expiry_of_each_lease(url: str, open_page: Open):
    with Api(url) as api:
        api.create_surrogate("leased", pendulum())
        _, failed = api.claim("leased", "arm-7", max_queries=2, lease_seconds=600).queries
        api.fail("leased", failed.id, failed.lease_token, "the arm is stuck")
        page = open_page(f"{url}/#/s/leased")
        rows = page.locator("#queue tbody tr")
        row = rows.filter(has_text="arm-7").filter(has_text="leased")
        expect(row).to_have_text(re.compile(r"(600|59\d) s"))
        expect(rows.filter(has_text="the arm is stuck")).to_contain_text("pending")
        page.get_by_label("queries to show").select_option("with errors")
        expect(rows).to_have_count(1)
        api.delete_surrogate("leased")


@pytest.mark.parametrize("width", [320, 390])
def test_the_dashboard_fits_a_phone_without_horizontal_scrolling(url: str, open_page: Open, width: int):
    page = open_page(url, width=width, height=800)
    expect(page.get_by_role("link", name=re.compile("^pendulum"))).to_be_visible()
    middles = page.locator(".top > :visible").evaluate_all(
        "all => all.map(({offsetTop: y, offsetHeight: h}) => y + h / 2)"
    )
    assert max(middles) - min(middles) < 5  # the header is one line
    overflow = "document.documentElement.scrollWidth - innerWidth"
    assert page.evaluate(overflow) <= 0
    page.goto(f"{url}/#/s/pendulum")
    assert opened(page).evaluate(overflow) <= 0


def test_an_admin_can_pause_improve_query_and_delete_on_the_dashboard(url: str, open_page: Open, complaints: list[str]):
    with Api(url) as api:
        api.create_surrogate("steered", pendulum())
        page = open_page(f"{url}/#/s/steered")
        page.get_by_role("button", name="Pause").click()
        expect(page.locator(".title")).to_contain_text("paused")
        before = api.surrogate("steered")
        assert before.paused
        page.get_by_role("button", name="Add to the budget").click()
        expect(page.locator("#actions")).to_contain_text(f"The budget is now {before.budget + 10}")
        page.get_by_role("button", name="Request this real step").click()
        expect(page.locator("#queue tbody tr").first).to_contain_text("manual")
        page.get_by_role("button", name="Delete…").click()
        confirm = page.get_by_role("dialog").get_by_role("button", name="Delete")
        expect(confirm).to_be_disabled()
        page.get_by_label("Type its name").fill("steered")
        confirm.click()
        expect(page.get_by_role("heading", name="Surrogates")).to_be_visible()
        assert "steered" not in [surrogate.name for surrogate in api.surrogates()]
    assert [said for said in complaints if "404" not in said] == []  # the page may ask once more for what is gone
