"""The extra ``server`` alone is enough to start a server, without Ray and whatever else is optional."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import httpx

from support.distributions import absent
from support.noting import until

STARTED = """
import json, runpy, sys

missing = json.loads(sys.argv.pop(1))
assert {"ray", "stable_baselines3", "onnx"} <= set(missing)
sys.modules.update(dict.fromkeys(missing))  # importing one of them fails as if it were not installed
runpy.run_module("surrogym_server", run_name="__main__")
"""


def test_a_server_starts_with_the_packages_of_its_extra_alone(tmp_path: Path) -> None:
    ready = tmp_path / "ready"
    options = ["serve", "--port", "0", "--database", str(tmp_path / "db"), "--ready-file", str(ready)]
    missing = json.dumps(absent("surrogym[server]"))
    with (tmp_path / "log").open("w") as log:
        server = subprocess.Popen([sys.executable, "-c", STARTED, missing, *options], stdout=log, stderr=log)
    try:
        until(lambda: ready.exists() or server.poll() is not None)
        assert ready.exists(), (tmp_path / "log").read_text()
        assert httpx.get(f"{ready.read_text().strip()}/healthz").status_code == 200
    finally:
        server.terminate()
        server.wait(30)
