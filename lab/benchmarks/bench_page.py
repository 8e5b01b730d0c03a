"""How long the page takes: a surrogate of 10,000 samples, 50 models and 20 policies in a real Chromium.

    python lab/benchmarks/bench_page.py

Prints milliseconds to the first paint, to the facts, to the last policy, from a key and from a click on a policy to the
next frame, and to the sentence of the comparison: the median of some loads, and the load of the machine.
"""

from __future__ import annotations

import os
import statistics
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))

import numpy as np
from playwright.sync_api import Browser

from support.browser import launched
from support.policies import store
from support.server import running_server
from support.teaching import teach
from surrogym_client.transport import Api
from surrogym_sampler.original.classic import pendulum
from surrogym_shared import wire

SAMPLES, MODELS, POLICIES, LOADS = 10_000, 50, 20, 5
NAME = "big"
PAINT = "performance.getEntriesByName('first-contentful-paint')[0]?.startTime"
FRAME = """async () => {{
  const begun = performance.now();
  {act};
  await new Promise((resolve) => requestAnimationFrame(() => setTimeout(resolve, 0)));
  return performance.now() - begun;
}}"""
KEY = FRAME.format(
    act="document.querySelector('.heat canvas').dispatchEvent(new KeyboardEvent('keydown', { key: 'ArrowRight' }))"
)
CLICK = FRAME.format(act="document.querySelector('.policies summary').click()")
NAMES = ("first paint", "facts", "last policy", "a key", "a click", "comparison")


def fill(api: Api) -> None:
    """The surrogate; its samples are a log that is not complete, so that no fit begins."""
    teach(api, NAME, pendulum(), queries=12)
    model = api.export_model(NAME, 1)
    for _ in range(MODELS - 1):
        api.import_model(NAME, model)
    states = np.random.default_rng(0).uniform((-3, -8), (3, 8), (SAMPLES, 2)).tolist()
    samples = [
        wire.NewSample(coordinates=q, action=[0.5], next_coordinates=q, reward=-1.0, terminated=False) for q in states
    ]
    api.add_samples(NAME, "log", samples, purpose="logged", complete=False)
    for number in range(POLICIES):
        store(api, NAME, number, -200.0 - number)


def load(browser: Browser, url: str) -> tuple[float, ...]:
    """Milliseconds of each of ``NAMES``."""
    page = browser.new_page(viewport={"width": 1280, "height": 900})
    page.goto("about:blank")
    begun = time.perf_counter()
    page.goto(f"{url}/#/s/{NAME}")
    page.locator(".facts .big").first.wait_for()
    facts = time.perf_counter()
    page.locator(".policies summary").nth(POLICIES - 1).wait_for()
    policies = time.perf_counter()
    page.wait_for_timeout(4_000)  # samples and models come
    key, click, painted = (page.evaluate(script) for script in (KEY, CLICK, PAINT))
    compared = time.perf_counter()
    page.goto(f"{url}/#/compare/{NAME}/{NAME}")
    page.locator("p.big").wait_for()
    said = time.perf_counter() - compared
    page.close()
    return painted, 1e3 * (facts - begun), 1e3 * (policies - begun), key, click, 1e3 * said


def main() -> None:
    with TemporaryDirectory() as folder, running_server(Path(folder)) as server:
        with Api(server.url) as api:
            fill(api)
        with launched() as browser:
            loads = [load(browser, server.url) for _ in range(LOADS)]
    print(f"load {os.getloadavg()[0]:.1f}")
    for name, column in zip(NAMES, zip(*loads, strict=True), strict=True):
        print(f"{name:12} {statistics.median(column):7.0f} ms, at most {max(column):.0f}")


if __name__ == "__main__":
    main()
