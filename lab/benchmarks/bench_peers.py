"""One lane stepped over the stream, beside other systems that serve a trivial environment, in the same run.

Run by ``make bench``. The others are installed by name from the package registry, once, into an environment of
their own. One that can't be installed or does not answer is left out, and it is said why. Rounds take
turns.
"""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))

from bench_step import TRIVIAL, echo_server, free_port, library_echo, remote, surrogym_server
from common import Subject, figures, parser, ratio, started, take_turns, timed, write
from owned import SCRIPT, Child, PeerFailed, installed

PEERS = ("openenv", "rlmesh", "dm_env_rpc")
ROUNDS, CALLS, WARM_UP = 30, 40, 100
STARTING_SECONDS = 180


@contextmanager
def peer(out: Path, name: str) -> Iterator[Subject]:
    """Steps of a peer's client against its server. Raises ``PeerFailed``."""
    python, port = installed(out, name), str(free_port())
    server = subprocess.Popen(
        [python, SCRIPT, "serve", name, port], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    try:
        with _client(python, name, port, server) as client:
            yield client
    finally:
        server.terminate()
        server.wait(30)


def _client(python: str, name: str, port: str, server: subprocess.Popen[bytes]) -> Child:
    deadline = time.monotonic() + STARTING_SECONDS
    while server.poll() is None and time.monotonic() < deadline:
        time.sleep(1)
        try:
            return Child(python, "step", name, port)
        except PeerFailed:
            continue
    raise PeerFailed("its server did not start")


def main() -> None:
    options = started(parser(__doc__))
    report: dict[str, Any] = {"skipped": {}}
    with ExitStack() as stack:
        echo, url = stack.enter_context(echo_server()), stack.enter_context(surrogym_server())
        subjects: dict[str, Subject] = {
            "echo": timed(library_echo(stack, echo, 1)),
            "Surrogym, stream": timed(remote(stack, url, TRIVIAL, "stream", 1)),
        }
        for name in PEERS:
            try:
                subjects[name] = stack.enter_context(peer(options.out, name))
            except (PeerFailed, OSError, subprocess.SubprocessError) as error:
                report["skipped"][name] = str(error)
                print(f"SKIPPED {name}: {error}")
        turns = take_turns(subjects, 3 if options.quick else ROUNDS, CALLS, WARM_UP)
    report["us"] = {
        name: {**figures(rounds), "to Surrogym": ratio(rounds, turns["Surrogym, stream"])}
        for name, rounds in turns.items()
    }
    print(f"{'N = 1, trivial':22}{'p50 us':>10}{'p99 us':>10}{'to Surrogym':>14}")
    for name, found in report["us"].items():
        print(f"{name:22}{found['p50']:10.0f}{found['p99']:10.0f}{found['to Surrogym']:14.2f}")
    write(options.out, "peers", report)


if __name__ == "__main__":
    main()
