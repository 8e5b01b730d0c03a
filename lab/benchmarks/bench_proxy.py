"""What HAProxy adds to a step, with the settings of docker/haproxy.cfg and with others, beside no proxy in one run."""

from __future__ import annotations

import sys
import tempfile
import time
from contextlib import ExitStack
from functools import partial
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))

import numpy as np
from common import parser, started, take_turns, timed, write

from support.haproxy import Proxy, program
from support.server import running_server
from support.teaching import teach
from surrogym_client.transport import Api, HttpSurrogate, Transport
from surrogym_sampler.original.classic import pendulum
from surrogym_shared.wire import OpenSession

TRANSPORTS: tuple[Transport, ...] = ("stream", "binary")
GLOBAL, HTTP = "    maxconn 8000", "    mode http\n"
NO_DELAY, BUFFER = f"{HTTP}    option http-no-delay\n", f"    tune.bufsize 65536\n{GLOBAL}"
SETTINGS = {
    "as shipped": {},
    "http-no-delay": {HTTP: NO_DELAY},
    "buffers of 64 KiB": {GLOBAL: BUFFER},
    "both": {HTTP: NO_DELAY, GLOBAL: BUFFER},
}
CALLS = {1: 60, 1_024: 40, 16_384: 10}
ROUNDS = 8


def proxied(stack: ExitStack, server: str, changes: dict[str, str]) -> str:
    """The address of an HAProxy before a server, with lines of its configuration changed."""
    folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
    proxy = Proxy(folder, [server.removeprefix("http://")])
    file = folder / "haproxy.cfg"
    text = file.read_text(encoding="utf-8")
    for before, after in changes.items():
        assert before in text
        text = text.replace(before, after)
    file.write_text(text, encoding="utf-8")
    proxy.start()
    stack.callback(proxy.kill)
    return proxy.url


def steps(urls: dict[str, str], lanes: int, rounds: int) -> dict[str, float]:
    """Median milliseconds of a step for each way."""
    with ExitStack() as stack:
        ways = {}
        for name, url in urls.items():
            for transport in TRANSPORTS:
                port = stack.enter_context(HttpSurrogate(url, "pendulum", transport=transport))
                session = port.open(OpenSession(num_envs=lanes, seed=1)).id
                port.reset(session)
                ways[f"{name}, {transport}"] = timed(partial(port.step, session, np.zeros((lanes, 1))))
        turns = take_turns(ways, rounds, CALLS[lanes], 5)
    return {name: 1e3 * float(np.median(np.concatenate(taken))) for name, taken in turns.items()}


def main() -> None:
    options = started(parser(__doc__))
    if program() is None:
        raise SystemExit("HAProxy is not on this machine: apt-get install haproxy")
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        server = stack.enter_context(running_server(folder, "--log-level", "warning"))
        with Api(server.url) as api:
            teach(api, "pendulum", pendulum(), queries=20)
        urls = {"no proxy": server.url}
        urls |= {name: proxied(stack, server.url, changes) for name, changes in SETTINGS.items()}
        time.sleep(3.0)  # until HAProxy has looked at its server
        report = {}
        for lanes in CALLS:
            report[lanes] = steps(urls, lanes, 2 if options.quick else ROUNDS)
            for name, taken in report[lanes].items():
                print(f"{lanes:6,} lanes, {name:28} {taken:6.2f} ms")
    write(options.out, "proxy", {"steps": report})


if __name__ == "__main__":
    main()
