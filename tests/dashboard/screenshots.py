"""Pictures of the page for docs/images: a real server, a Pendulum learned from real steps, two policies with real
episodes, and one in training."""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "tests"))

from playwright.sync_api import Browser, Page, expect  # noqa: E402

from support.browser import launched  # noqa: E402
from support.server import running_server  # noqa: E402
from surrogym_sampler.original.classic import mountain_car_continuous as mountain_car  # noqa: E402

IMAGES = ROOT / "docs" / "images"
QUEUED = "CartPole-v1"
TRAININGS = {"short": "30000", "long": "450000"}  # virtual steps; the second policy is a good one


def surrogym(url: str, *words: str) -> None:
    subprocess.run([sys.executable, "-m", "surrogym", *words, "--server", url, "--quiet"], check=True)


def populate(url: str, folder: Path) -> None:
    """A finished Pendulum with two policies, and a CartPole that waits for a sampler."""
    surrogym(url, "register", "Pendulum-v1", "--name", "pendulum")
    surrogym(url, "register", QUEUED, "--name", "cartpole")
    surrogym(url, "sample", "pendulum", "--until-done")
    for name, steps in TRAININGS.items():
        policy = str(folder / f"{name}.zip")
        surrogym(url, "train", "pendulum", "--steps", steps, "--out", policy)
        surrogym(url, "evaluate", policy, "--episodes", "30", "--compare", "zero", "--video")


def take(browser: Browser, url: str, name: str, path: str, scheme: str, width: int, height: int) -> None:
    context = browser.new_context(
        viewport={"width": width, "height": height}, color_scheme="dark" if scheme == "dark" else "light"
    )
    page = context.new_page()
    page.goto(f"{url}/{path}")
    settle(page, path)
    page.screenshot(path=IMAGES / f"{name}.png")  # what fits the window, no strip
    context.close()


def take_policy(browser: Browser, url: str) -> None:
    """The newest policy, opened, a second into its video."""
    page = browser.new_page(viewport={"width": 1100, "height": 900})
    page.goto(f"{url}/#/s/pendulum")
    settle(page, "#/s/pendulum")
    page.locator("#policies summary").first.click()
    expect(page.locator("#policies .episodes canvas")).to_have_count(2)
    page.evaluate("document.querySelector('video.video') && (document.querySelector('video.video').currentTime = 1)")
    page.wait_for_timeout(1_000)
    page.locator("#policies").screenshot(path=IMAGES / "page-policy.png")
    page.close()


def take_registration(browser: Browser, url: str) -> None:
    """A specification, checked and shown before it is registered."""
    page = browser.new_page(viewport={"width": 1100, "height": 900})
    page.goto(f"{url}/#/register")
    page.get_by_label("or paste its text").fill(mountain_car().model_dump_json(indent=1))
    page.get_by_role("button", name="Check", exact=True).click()
    page.get_by_role("button", name="Register").wait_for()
    page.evaluate("document.querySelector('#spec').scrollTop = 0")
    page.screenshot(path=IMAGES / "page-register.png", full_page=True)
    page.close()


def settle(page: Page, path: str) -> None:
    expect.set_options(timeout=30_000)
    expect(page.locator("#connection")).to_have_text("live")
    if path.startswith("#/compare"):
        expect(page.locator("main .ranges")).to_be_visible()
    elif path != "#/":
        expect(page.locator(".rolled .episodes canvas")).to_have_count(3)
        expect(page.locator("#maps")).to_contain_text("of the tolerance on this cut")
        expect(page.locator(".facts")).to_contain_text("Least certain near")
        expect(page.locator("#sessions tbody")).to_be_visible()
    page.wait_for_timeout(600)  # transitions


def main() -> None:
    IMAGES.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as folder, running_server(Path(folder)) as server, launched() as browser:
        populate(server.url, Path(folder))
        command = ["train", "pendulum", "--steps", "1000000", "--penalty", "1", "--out", f"{folder}/policy.zip"]
        training = subprocess.Popen([sys.executable, "-m", "surrogym", *command, "--server", server.url, "--quiet"])
        try:
            wait_for_episodes(browser, server.url)
            take(browser, server.url, "page-list", "#/", "light", 1100, 420)
            take(browser, server.url, "page-light", "#/s/pendulum", "light", 1280, 800)
            take(browser, server.url, "page-compare", "#/compare/pendulum/pendulum", "light", 1100, 600)
            take_policy(browser, server.url)
            take_registration(browser, server.url)
        finally:
            training.terminate()
            training.wait()


def wait_for_episodes(browser: Browser, url: str) -> None:
    page = browser.new_page()
    page.goto(f"{url}/#/s/pendulum")
    page.locator("#sessions .spark").wait_for(timeout=180_000)
    page.close()


if __name__ == "__main__":
    main()
