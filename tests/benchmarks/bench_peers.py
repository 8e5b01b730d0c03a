"""One lane stepped over the stream, beside other systems that serve a trivial environment, in the same run.

Run by ``make bench``. The others are installed by name from the package registry, once, into an environment of
their own. One that can't be installed or does not answer is left out, and it is said why. Rounds take
turns.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
import venv
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))

import numpy as np
from bench_step import TRIVIAL, echo_server, free_port, library_echo, machine, remote, surrogym_server

PEERS = {"openenv": ["openenv-core"], "rlmesh": ["rlmesh[gymnasium,numpy]"], "dm_env_rpc": ["dm-env-rpc"]}
CONSTRAINTS = Path(__file__).parents[2] / "constraints.txt"  # the one build of torch too, should one ask for it
SCRIPT = str(Path(__file__).with_name("peers.py"))
ROUNDS, CALLS, WARM_UP = 20, 40, 100
INSTALLING_SECONDS, STARTING_SECONDS = 600, 60


def installed(folder: Path, name: str) -> str:
    """The Python that has a peer. Raises RuntimeError with the installer's last words."""
    python, mark = folder / "bin/python", folder / f"{name}.installed"
    if not python.exists():
        venv.create(folder, with_pip=True)
    if not mark.exists():
        command = [str(python), "-m", "pip", "install", "-q", "-c", str(CONSTRAINTS), *PEERS[name]]
        done = subprocess.run(command, capture_output=True, text=True, timeout=INSTALLING_SECONDS)
        if done.returncode:
            raise RuntimeError(f"pip: {done.stderr.strip().splitlines()[-1]}")
        mark.touch()
    return str(python)


class Client:
    """A peer's client in a process of its own."""

    def __init__(self, python: str, name: str, port: int) -> None:
        arguments = [python, SCRIPT, "step", name, str(port)]
        self.process = subprocess.Popen(
            arguments, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
        )
        self._read()

    def steps(self, count: int) -> list[float]:
        assert self.process.stdin is not None
        self.process.stdin.write(f"{count}\n")
        self.process.stdin.flush()
        return self._read()

    def _read(self) -> list[float]:
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        if not line:
            raise RuntimeError("its client ended")
        answer: list[float] = json.loads(line)
        return answer


@contextmanager
def peer(folder: Path, name: str) -> Iterator[Client]:
    python, port = installed(folder, name), free_port()
    server = subprocess.Popen(
        [python, SCRIPT, "serve", name, str(port)], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    client = None
    try:
        deadline = time.monotonic() + STARTING_SECONDS
        while client is None:
            if server.poll() is not None or time.monotonic() > deadline:
                raise RuntimeError("its server did not start")
            time.sleep(1)
            try:
                client = Client(python, name, port)
            except RuntimeError:
                continue
        yield client
    finally:
        for child in (server, *([] if client is None else [client.process])):
            child.terminate()
            child.wait(30)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("build/benchmarks"), help="folder of the JSON file")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    report: dict[str, Any] = {"machine": machine(), "skipped": {}}
    with ExitStack() as stack:
        echo, url = stack.enter_context(echo_server()), stack.enter_context(surrogym_server())
        clients: dict[str, Client] = {}
        for name in PEERS:
            try:
                clients[name] = stack.enter_context(peer(options.out / "peers", name))
            except (RuntimeError, OSError, subprocess.SubprocessError) as error:
                report["skipped"][name] = str(error)
                print(f"SKIPPED {name}: {error}")
        ours = {"echo": library_echo(stack, echo, 1), "Surrogym, stream": remote(stack, url, TRIVIAL, "stream", 1)}
        taken: dict[str, list[float]] = {name: [] for name in (*ours, *clients)}
        for name in taken:
            steps(ours, clients, name, WARM_UP)
        for _ in range(ROUNDS):
            for name, seconds in taken.items():
                seconds += steps(ours, clients, name, CALLS)
    report["us"] = {name: list(np.quantile(seconds, [0.5, 0.99]) * 1e6) for name, seconds in taken.items()}
    print(f"{'N = 1, trivial':22}{'p50 us':>10}{'p99 us':>10}")
    for name, (p50, p99) in report["us"].items():
        print(f"{name:22}{p50:10.0f}{p99:10.0f}")
    (options.out / "peers.json").write_text(json.dumps(report, indent=1))


def steps(ours: dict[str, Any], clients: dict[str, Client], name: str, count: int) -> list[float]:
    if name in clients:
        return clients[name].steps(count)
    taken = []
    for _ in range(count):
        start = time.perf_counter()
        ours[name]()
        taken.append(time.perf_counter() - start)
    return taken


if __name__ == "__main__":
    main()
