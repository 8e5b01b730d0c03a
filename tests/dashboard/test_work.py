"""Trainings and evaluations from the page: started, followed live, cancelled, and their results shown."""

from __future__ import annotations

import re
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Locator, Page, Route, expect

from support.browser import serious
from support.policies import left_alone, network_file
from support.server import ServerProcess
from surrogym_client.transport import Api
from surrogym_sampler.original.classic import pendulum
from surrogym_sampler.original.episodes import GymnasiumEpisode
from surrogym_shared import wire
from surrogym_trainer.work.worker import Environment, Worker, WorkerSettings

Open = Callable[..., Page]
NAME = "pendulum"
OVERFLOW = "document.documentElement.scrollWidth - innerWidth"


@pytest.fixture
def api(pendulum_server: ServerProcess) -> Iterator[Api]:
    expect.set_options(timeout=60_000)
    with Api(pendulum_server.url) as opened, left_alone(opened, NAME):
        yield opened


@pytest.fixture
def works(api: Api, tmp_path: Path) -> Iterator[Callable[[], None]]:
    """Let a worker run the next job of the surrogate in a thread."""
    threads: list[threading.Thread] = []

    def run() -> None:
        with Api(api.url) as own:
            environment = Environment(pendulum(), lambda: GymnasiumEpisode(pendulum()), 50)
            Worker(own, NAME, WorkerSettings("trainer-1", tmp_path, once=True), environment).run()

    def begin() -> None:
        threads.append(threading.Thread(target=run))
        threads[-1].start()

    yield begin
    for thread in threads:
        thread.join(60)


def part(page: Page) -> Locator:
    return page.locator("#work")


def test_without_a_worker_the_dashboard_shows_the_command_that_starts_one(
    api: Api, open_page: Open, complaints: list[str]
):
    api.create_surrogate("idle", pendulum())
    page = open_page(f"{api.url}/#/s/idle")
    expect(part(page)).to_contain_text(f"To start one: surrogym work idle --server {api.url}")
    expect(part(page)).to_contain_text("There is no model yet")
    for name in ("Start training", "Evaluate"):
        expect(part(page).get_by_role("button", name=name)).to_be_disabled()
    assert serious(page) == []
    assert complaints == []
    api.delete_surrogate("idle")


def test_a_training_can_be_started_followed_and_cancelled_on_the_dashboard(
    api: Api, open_page: Open, works: Callable[[], None], complaints: list[str]
):
    works()
    page = open_page(f"{api.url}/#/s/{NAME}")
    here = part(page)
    expect(here).to_contain_text("trainer-1 (evaluates in up to 50 real episodes)")
    here.get_by_label("Length").select_option("so many virtual steps")
    here.get_by_label("Virtual steps", exact=True).fill("500000")
    here.get_by_label("Audit by").uncheck()
    here.get_by_role("button", name="Start training").press("Enter")
    expect(here).to_contain_text(re.compile(r"Job \d+: train, seed 0, 500 000 virtual steps"))
    expect(here.locator(".job canvas")).to_be_visible()
    expect(here.locator(".job")).to_contain_text(
        re.compile(r"trainer-1: training, [\d ]+ of [\d ]+ virtual steps, imagined")
    )
    expect(here.locator(".job")).to_contain_text("The policy learns while the line rises.")
    assert serious(page) == []
    here.get_by_role("button", name="Cancel job").click()
    row = here.get_by_role("list", name="Jobs that have ended").locator("li").first
    expect(row).to_contain_text("cancelled by a person")
    expect(here.locator(".job")).to_have_count(0)
    row.get_by_role("button", name=re.compile(r"^version \d+$")).click()
    expect(page.locator("#policies details[open]")).to_have_count(1)
    assert serious(page) == []
    assert complaints == []


def test_job_progress_appears_on_the_dashboard_within_two_seconds(api: Api, open_page: Open):
    id = api.jobs.add(NAME, wire.TrainTask(kind="train")).id
    job = api.jobs.claim(NAME, "by-hand")
    assert job is not None
    page = open_page(f"{api.url}/#/s/{NAME}")
    expect(part(page).locator(".job")).to_contain_text(f"Job {id}")
    curve: list[wire.JobPoint] = []
    for steps in (1_000, 2_000, 3_000):
        curve.append(wire.JobPoint(steps=steps, imagined_return=-steps / 7))
        state = wire.JobState(
            stage="training", share=0.1, steps=steps, total_steps=30_000, imagined_return=-steps / 7, curve=curve
        )
        api.jobs.report(NAME, id, job.lease_token, state=state)
        expect(part(page).locator(".job")).to_contain_text(f"{steps:,}".replace(",", " "), timeout=2_000)
    api.jobs.finish(NAME, id, job.lease_token, "failed", error="the disk is full")
    expect(part(page).get_by_role("status")).to_contain_text("failed, the disk is full", timeout=2_000)


def test_an_evaluation_started_on_the_dashboard_shows_its_result(api: Api, open_page: Open, works: Callable[[], None]):
    version = api.policies.push(NAME, wire.PushedCard(algorithm="CMAES"), [], "zip", network_file(seed=8)).version
    works()
    page = open_page(f"{api.url}/#/s/{NAME}")
    here = part(page)
    expect(here).to_contain_text("trainer-1")
    expect(here.get_by_label("Policy", exact=True)).to_have_value(str(version))
    version = api.policies.push(NAME, wire.PushedCard(algorithm="CMAES"), [], "zip", network_file(seed=10)).version
    expect(here.get_by_label("Policy", exact=True)).to_have_value(str(version))  # the newest, as before
    here.get_by_label("Real episodes").fill("3")
    here.get_by_label("Compare with").select_option("an action of zero")
    expect(here).to_contain_text("6 episodes of the original environment: up to 1 200 real steps.")
    here.get_by_role("button", name="Evaluate").click()
    row = here.get_by_role("list", name="Jobs that have ended").locator("li").first
    expect(row).to_contain_text(f"evaluate version {version} in 3 real episodes, compared with an action of zero")
    expect(row).to_contain_text(re.compile(f"done.*version {version}: No promise; real mean return .* in 3 episodes"))


def test_the_dashboard_can_request_a_reference_controller_and_a_video(api: Api, open_page: Open):
    version = api.policies.push(NAME, wire.PushedCard(algorithm="CMAES"), [], "zip", network_file(seed=9)).version
    api.jobs.claim(NAME, "plain", most_episodes=50)
    page = open_page(f"{api.url}/#/s/{NAME}")
    here = part(page)
    expect(here).to_contain_text("plain (evaluates in up to 50 real episodes)")
    expect(here.get_by_label("worker's reference controller")).to_be_hidden()
    api.jobs.claim(NAME, "able", most_episodes=50, reference=True)
    expect(here).to_contain_text("able (evaluates in up to 50 real episodes, has a reference controller)")
    here.get_by_label("Policy", exact=True).select_option(f"version {version}")
    here.get_by_label("worker's reference controller").check()
    here.get_by_label("Draw a video").check()
    here.get_by_label("Real episodes").fill("4")
    expect(here).to_contain_text("8 episodes of the original environment: up to 1 600 real steps.")
    assert serious(page) == []
    here.get_by_role("button", name="Evaluate").click()
    words = f"evaluate version {version} in 4 real episodes, compared with the reference controller, with a video"
    expect(here.locator(".job")).to_contain_text(words)
    job = api.jobs.list(NAME).jobs[0]
    api.jobs.cancel(NAME, job.id)
    asked = wire.EvaluateTask(kind="evaluate", policy=str(version), episodes=4, reference=True, video=True)
    assert job.task == asked


def test_a_read_token_can_see_but_not_start_jobs_on_the_dashboard(api: Api, open_page: Open):
    id = api.jobs.add(NAME, wire.TrainTask(kind="train")).id
    page = open_page("about:blank")
    page.route("**/v1/access", lambda route: _as_reader(route))
    page.goto(f"{api.url}/#/s/{NAME}")
    expect(part(page)).to_contain_text("This token's role is read. One with role train or admin may start and cancel.")
    expect(part(page).locator(".job")).to_contain_text(f"Job {id}")
    expect(part(page).get_by_role("button", name=re.compile("Cancel|Start|Evaluate"))).to_have_count(0)


def _as_reader(route: Route) -> None:
    route.fulfill(json={"role": "read", "tokens": True})


@pytest.mark.parametrize(("scheme", "width"), [("dark", 1280), ("light", 320)])
def test_the_dashboard_jobs_are_readable_in_dark_mode_and_on_a_phone(
    api: Api, open_page: Open, scheme: str, width: int
):
    id = api.jobs.add(NAME, wire.TrainTask(kind="train")).id
    job = api.jobs.claim(NAME, "by-hand")
    assert job is not None
    curve = [wire.JobPoint(steps=1_000 * n, imagined_return=-1_000 / n) for n in range(1, 20)]
    state = wire.JobState(stage="training", share=0.5, steps=19_000, total_steps=38_000, curve=curve)
    api.jobs.report(NAME, id, job.lease_token, state=state)
    page = open_page(f"{api.url}/#/s/{NAME}", scheme=scheme, width=width)
    expect(part(page).locator(".job canvas")).to_be_visible()
    assert serious(page) == []
    assert page.evaluate(OVERFLOW) <= 0
    api.jobs.finish(NAME, id, job.lease_token, "done")
