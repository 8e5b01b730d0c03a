"""How long /healthz takes, and how much memory the server has, while somebody attacks it. Run by ``make bench``.

Four connections of another process send as fast as they can, and open again when the server closes them. "Ordinary
requests" are the same number of connections that ask for what is allowed: so much of the latency is the load itself.
The attacker shares the machine with the server, so measure on two free cores at least.
"""

from __future__ import annotations

import itertools
import multiprocessing
import statistics
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))

import httpx
import numpy as np
from common import parser, started, write

from support.hostile import connected, head, resident_mib
from support.server import running_server

TOKEN = "of-this-benchmark"
CONNECTIONS, SECONDS, QUICK_SECONDS = 4, 10.0, 2.0
PAUSE = 0.005  # between two looks at /healthz
PIECE = 64 * 1024
KNOWN = f"authorization: Bearer {TOKEN}"

Pieces = Callable[[], Iterator[bytes]]


def ordinary() -> Iterator[bytes]:
    yield f"GET /v1/surrogates HTTP/1.1\r\nhost: 127.0.0.1\r\n{KNOWN}\r\nconnection: close\r\n\r\n".encode()


def header_without_end() -> Iterator[bytes]:
    yield b"GET /healthz HTTP/1.1\r\nhost: 127.0.0.1\r\nx: "
    yield from itertools.repeat(b"a" * PIECE)


def headers_without_number() -> Iterator[bytes]:
    yield b"GET /healthz HTTP/1.1\r\nhost: 127.0.0.1\r\n"
    yield from itertools.repeat(b"x: a\r\n" * (PIECE // 6))


def target_without_end() -> Iterator[bytes]:
    yield b"GET /"
    yield from itertools.repeat(b"a" * PIECE)


def trailers_without_end() -> Iterator[bytes]:
    yield head("/v1/surrogates", KNOWN, "transfer-encoding: chunked") + b"\r\n\r\n0\r\n"
    yield from itertools.repeat(b"x: a\r\n" * (PIECE // 6))


def body(megabytes: float, *lines: str) -> Pieces:
    """A POST of JSON of many small numbers."""
    numbers = b"[" + b"1.25," * int(megabytes * 200_000) + b"1]"

    def pieces() -> Iterator[bytes]:
        yield head("/v1/surrogates", f"content-length: {len(numbers)}", *lines) + b"\r\n\r\n"
        for at in range(0, len(numbers), PIECE):
            yield numbers[at : at + PIECE]

    return pieces


ATTACKS: dict[str, Pieces] = {
    "ordinary requests": ordinary,
    "one header without end": header_without_end,
    "headers without number": headers_without_number,
    "a target without end": target_without_end,
    "trailers without end": trailers_without_end,
    "30 MB of JSON, no token": body(30.0),
    "30 MB of JSON, token": body(30.0, KNOWN),
    "JSON just below the limit, token": body(0.12, KNOWN, "connection: close"),
}


def attack(url: str, pieces: Pieces, stop: threading.Event) -> None:
    """Send pieces on one connection after another until told to stop."""
    while not stop.is_set():
        with connected(url) as opened:
            try:
                for piece in pieces():
                    opened.sendall(piece)
                    if stop.is_set():
                        return
                opened.recv(PIECE)
            except OSError:
                continue


def attacker(url: str, name: str, stop: threading.Event) -> None:
    threads = [threading.Thread(target=attack, args=(url, ATTACKS[name], stop)) for _ in range(CONNECTIONS)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()


def latencies(client: httpx.Client, seconds: float) -> list[float]:
    """Milliseconds of /healthz."""
    taken, end = [], time.monotonic() + seconds
    while time.monotonic() < end:
        start = time.perf_counter()
        client.get("/healthz").raise_for_status()
        taken.append(1e3 * (time.perf_counter() - start))
        time.sleep(PAUSE)
    return taken


def under(url: str, pid: int, name: str, seconds: float) -> dict[str, float]:
    """Latencies of /healthz in ms and resident memory in MiB under one attack."""
    spawning = multiprocessing.get_context("spawn")
    stop = spawning.Event()
    child = spawning.Process(target=attacker, args=(url, name, stop), daemon=True)
    with httpx.Client(base_url=url, timeout=60) as client:
        latencies(client, 0.5)
        before = resident_mib(pid)
        child.start()
        time.sleep(0.5)
        taken = latencies(client, seconds)
        after = resident_mib(pid)
    stop.set()
    child.join(5.0)
    child.kill()
    return {
        "p50 ms": statistics.median(taken),
        "p99 ms": float(np.quantile(taken, 0.99)),
        "worst ms": max(taken),
        "MiB before": before,
        "MiB after": after,
    }


def main() -> None:
    options = started(parser(__doc__))
    seconds = QUICK_SECONDS if options.quick else SECONDS
    with TemporaryDirectory() as folder, running_server(Path(folder), SURROGYM_TOKEN=TOKEN) as server:
        found = {}
        for name in ATTACKS:
            found[name] = under(server.url, server.process.pid, name, seconds)
            print(f"{name:34}" + ", ".join(f"{what} {figure:.1f}" for what, figure in found[name].items()))
    write(options.out, "attacks", {"connections": CONNECTIONS, "attacks": found})


if __name__ == "__main__":
    main()
