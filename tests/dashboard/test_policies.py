"""Policies on the page: promise beside real return, aliases, episodes, files, and two surrogates compared."""

from __future__ import annotations

import itertools
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from statistics import NormalDist

import numpy as np
import pytest
from playwright.sync_api import Page, expect

from support.browser import serious
from support.policies import store
from support.server import ServerProcess
from surrogym_client.transport import Api
from surrogym_sampler.original.classic import cartpole, pendulum
from surrogym_shared import wire
from surrogym_shared.wire.policies import AddDrift, PolicyFallback
from surrogym_trainer.evaluation.evaluator import Evaluation, Trace
from surrogym_trainer.evaluation.videos import record

Open = Callable[..., Page]


@pytest.fixture(scope="module")
def url(pendulum_server: ServerProcess) -> Iterator[str]:
    """A server with two surrogates of the same environment; the second has the better policies."""
    expect.set_options(timeout=30_000)
    with Api(pendulum_server.url) as api:
        for name, means in (("worse", (-300, -250)), ("better", (-260, -150))):
            api.create_surrogate(name, pendulum())
            for number, mean in enumerate(means):
                store(api, name, seed=100 * len(name) + number, mean=mean)
        reference = wire.AddEvaluation(
            controller="reference",
            first_seed=10_000,
            returns=[-200.0, -220.0],
            lengths=[200] * 2,
            note="declared starts",
            idempotency_key="reference",
        )
        api.policies.evaluate("better", 2, reference)
        api.create_surrogate("bare", pendulum())
        yield pendulum_server.url
        for name in ("worse", "better", "bare"):
            api.delete_surrogate(name)


def test_the_dashboard_shows_promised_and_real_return_of_a_policy(url: str, open_page: Open, complaints: list[str]):
    page = open_page(f"{url}/#/s/better")
    part = page.locator("#policies")
    expect(part.locator("summary").first).to_contain_text(
        re.compile(r"version 2 .*Promised −170 to −130; real mean return −1[45]\d")
    )
    expect(part.locator("summary").first).to_contain_text("the promise was kept")
    picture = part.locator(".ranges")
    expect(picture).to_have_attribute(
        "aria-label", re.compile(r"better@2: promise −150 between −170 and −130, real .*without .*, reference −210 ")
    )
    part.locator("summary").first.click()
    expect(part.get_by_role("region", name="Real episodes of version 2")).to_contain_text("an action of zero")
    expect(part.get_by_role("region", name="Real episodes of version 2")).to_contain_text("the reference controller")
    expect(part.locator(".episodes canvas")).to_have_count(2)  # a picture for each coordinate
    part.get_by_role("button", name="Make it production").click()
    expect(part.locator("summary").first).to_contain_text("production")
    assert complaints == []


def test_the_dashboard_shows_the_expected_share_of_episodes_with_a_fallback(url: str, open_page: Open):
    share = PolicyFallback(mean=0.031, median=0.0, low=0.0, high=0.09)
    with Api(url) as api:
        promise = wire.PolicyPromise(median=-150, low=-170, high=-130, fallback=share)
        store(api, "bare", seed=1, mean=-150, promise=promise)
    said = "the fallback is expected in 3.1 % of the episodes (0 % to 9 %), so no more leave a limit"
    expect(open_page(f"{url}/#/s/bare").locator("#policies summary").first).to_contain_text(said)


def test_the_dashboard_shows_drift_as_soon_as_it_is_reported(url: str, open_page: Open, complaints: list[str]):
    page = open_page(f"{url}/#/s/worse")
    first = page.locator("#policies summary").last
    expect(first).to_contain_text("real mean return")
    expect(first).not_to_contain_text("Not trusted: since")
    drift = AddDrift(output="speed", error=0.1, words="speed is off", steps=9, idempotency_key="a")
    with Api(url) as api:
        api.connection.send("POST", "/v1/surrogates/worse/policies/1/drifts", drift.model_dump_json().encode())
    expect(first).to_contain_text(re.compile(r"Not trusted: since 20\d\d-.* UTC, drift: speed is off"))
    assert complaints == []


def test_the_return_axis_of_the_dashboard_has_round_numbers(url: str, open_page: Open):
    page = open_page(f"{url}/#/s/better")
    expect(page.locator(".ranges")).to_be_visible()
    ticks = [float(text.replace("−", "-")) for text in page.locator(".ranges line.axis ~ text").all_text_contents()]
    steps = {f"{after - before:.3g}" for before, after in itertools.pairwise(ticks)}
    assert len(ticks) >= 2
    assert len(steps) == 1
    assert steps.pop().strip("0.") in {"1", "2", "5"}


def test_a_policy_file_downloaded_from_the_dashboard_is_unchanged(url: str, open_page: Open, tmp_path: Path):
    page = open_page(f"{url}/#/s/worse")
    page.locator("#policies summary").last.click()
    with page.expect_download() as downloading:
        page.get_by_role("button", name=re.compile("^Download zip")).click()
    assert downloading.value.suggested_filename == "worse-1.zip"
    downloading.value.save_as(tmp_path / "got.zip")
    with Api(url) as api:
        assert (tmp_path / "got.zip").read_bytes() == api.policies.file("worse", 1, "zip")


def test_the_dashboard_names_the_better_of_two_policies_with_its_interval(
    url: str, open_page: Open, complaints: list[str]
):
    page = open_page(f"{url}/#/compare/worse/better")
    said = page.locator(".big")
    by, low, high = (f"{value:.{0 if value >= 100 else 1}f}" for value in paired(pairs=6))
    expect(said).to_have_text(re.compile(rf"^better@2.* is better than worse@2 by {by} \(95 %: {low} to {high}\)\.$"))
    expect(page.locator("main")).to_contain_text("Both ran the same 30 starts")
    picture = page.locator(".ranges")
    expect(picture).to_have_attribute("aria-label", re.compile("better@2.*: real .*worse@2: real .*worse@1"))
    rows = page.get_by_role("region", name="Each policy beside the best").locator("tbody tr")
    expect(rows).to_have_count(4)
    expect(rows.first).to_contain_text("the best")
    assert serious(page) == []
    page.get_by_role("combobox").nth(1).select_option("bare")
    expect(said).to_contain_text("are needed to say which is better")
    page.get_by_role("combobox").nth(0).select_option("pendulum")
    expect(page.locator("main")).to_contain_text("Neither has a policy yet.")
    assert complaints == []


def paired(pairs: int) -> tuple[float, float, float]:
    """By how much better@2 is better than worse@2 start by start, and the interval of one of so many pairs."""
    returns = [mean + np.random.default_rng(seed).normal(0, 10, 30) for seed, mean in ((601, -150), (501, -250))]
    gaps = returns[0] - returns[1]
    reach = NormalDist().inv_cdf(1 - 0.025 / pairs) * gaps.std(ddof=1) / np.sqrt(len(gaps))
    return gaps.mean(), gaps.mean() - reach, gaps.mean() + reach


def test_the_dashboard_difference_of_policies_is_paired_only_for_equal_start_seeds(url: str, open_page: Open):
    page = open_page(f"{url}/#/compare/better/better")
    expect(page.locator(".big")).to_contain_text(re.compile("^better@2.* is better than better@1 by"))
    found = page.evaluate("""async () => {
      const { difference, tail } = await import("/page/differences.js");
      const entry = (mean, seed) => ({ returns: [mean - 1, mean + 1], policy: { evaluations: [{ controller: "policy",
        declared: true, own: true, seeded: true, first_seed: seed, note: "", mean,
        mean_interval: { low: mean - 3, high: mean + 3 } }] } });
      return { same: difference(entry(5, 1), entry(2, 1)), other: difference(entry(5, 1), entry(2, 7)),
        z: [0.025, 0.025 / 9].map(tail) };
    }""")
    assert found["same"] == {"by": 3, "low": 3, "high": 3, "paired": True}  # the same gap at each start
    assert found["other"]["high"] - 3 == pytest.approx(3 * 2**0.5, rel=1e-6)
    assert found["z"] == pytest.approx([NormalDist().inv_cdf(1 - share) for share in (0.025, 0.025 / 9)], rel=1e-8)


def test_the_dashboard_tells_how_to_get_a_missing_model_or_policy(url: str, open_page: Open):
    page = open_page(f"{url}/#/s/bare")
    expect(page.locator("#policies")).to_contain_text("No policy is stored. surrogym train bare")
    for empty in ("#learning", ".maps", "#probe .rolled"):
        expect(page.locator(empty)).to_be_hidden()
    expect(page.get_by_role("button", name="Request this real step")).to_be_visible()
    assert serious(page) == []


def test_the_dashboard_reports_damaged_episodes_and_shows_the_rest(
    url: str, open_page: Open, pendulum_server: ServerProcess, complaints: list[str]
):
    with Api(url) as api:
        store(api, "bare", seed=7, mean=-200.0)
    folder = pendulum_server.folder / "surrogym.db.files"
    for path in sorted(folder.iterdir(), key=lambda path: path.stat().st_mtime_ns)[-3:]:
        path.write_bytes(b"broken")
    page = open_page(f"{url}/#/s/bare")
    part = page.locator("#policies")
    part.locator("summary").first.click()
    expect(part).to_contain_text("The single episodes can't be shown")
    expect(part).to_contain_text("Promised −220 to −180")
    page.get_by_role("button", name=re.compile("^Download zip")).click()
    expect(part.get_by_role("alert")).to_contain_text("has changed since it was stored")
    with Api(url) as api:
        api.policies.delete("bare", 1)
    assert [said for said in complaints if "500" not in said] == []


def test_the_dashboard_plays_a_video_and_reports_a_broken_one(
    url: str, open_page: Open, pendulum_server: ServerProcess
):
    plain = cartpole()
    way = np.zeros((11, 4))
    way[:, 0] = np.linspace(0, 1, 11)
    ones = Evaluation(np.ones(1), np.array([10]), None, (Trace(way, np.zeros((10, 1)), np.ones(10)),))
    with Api(url) as api:
        video = record(plain, None, ones, "declared starts")
        api.policies.put_file("better", 1, video.form, video.content)
        api.policies.put_file("worse", 1, "mp4", b"\0\0\0\x20ftypisom" + bytes(500))
        page = open_page(f"{url}/#/s/better")
        page.locator("#policies summary").last.click()
        shown = page.locator("#policies video, #policies img.video")
        expect(shown).to_be_visible()
        if video.form == "mp4":  # Chromium of a distribution may know no H.264
            page.wait_for_function(
                "() => document.querySelector('video.video')?.readyState > 0 || !document.querySelector('video.video')"
            )
        assert serious(page) == []
        page = open_page(f"{url}/#/s/worse")
        page.locator("#policies summary").last.click()
        expect(page.locator("#policies")).to_contain_text("The video can't be played")
        expect(page.locator("#policies .episodes canvas")).to_have_count(2)
        newer = page.locator("#policies summary").first
        newer.click()
        expect(page.locator("#policies")).to_contain_text("No video: surrogym evaluate --video")


@pytest.mark.parametrize(
    ("where", "scheme", "width"),
    [("", "light", 1280), ("s/better", "dark", 1280), ("s/pendulum", "light", 390)]
    + [(where, "dark", 390) for where in ("compare/worse/better", "register", "s/absent")],
)
def test_the_accessibility_checker_axe_finds_no_serious_fault_on_the_dashboard(
    url: str, open_page: Open, where: str, scheme: str, width: int
):
    page = open_page(f"{url}/#/{where}", scheme=scheme, width=width)
    if where == "register":
        page.get_by_text("Start from a log instead").click()
        page.get_by_text("The columns have other names").click()
    elif where == "s/absent":
        expect(page.get_by_role("alert").filter(has_text="no surrogate")).to_be_visible()
    elif where.startswith("compare"):
        expect(page.locator(".ranges")).to_be_visible()
    elif where:
        page.locator("#policies").wait_for()
        if where == "s/pendulum":
            expect(page.locator("#maps")).to_contain_text("of the tolerance on this cut")
        else:
            page.locator("#policies summary").first.click()
            expect(page.locator("#policies .episodes canvas")).to_have_count(2)
    else:
        expect(page.get_by_role("link", name=re.compile("^pendulum"))).to_be_visible()
    assert serious(page) == []
    if width == 390:
        assert page.evaluate("document.documentElement.scrollWidth - innerWidth") <= 0  # no sideways scrolling


def test_a_long_surrogate_name_fits_a_narrow_screen_on_the_dashboard(url: str, open_page: Open):
    """The lists to choose from have the names of all surrogates, also of those that are not compared."""
    name = "w" * 64
    with Api(url) as api:
        api.create_surrogate(name, pendulum())
        try:
            page = open_page(f"{url}/#/compare/worse/better", width=390)
            expect(page.locator(".ranges")).to_be_visible()
            assert page.evaluate("document.documentElement.scrollWidth - innerWidth") <= 0
        finally:
            api.delete_surrogate(name)
