"""What a step costs over each transport, beside a bare echo of as many bytes in the same run.

Run by ``make bench``. Rounds of every subject take turns, so that what else the machine does hits all alike;
read the ratios, not the microseconds.
"""

from __future__ import annotations

import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))

import numpy as np
import pytest
from common import MICROSECONDS, Call, figures, parser, ratio, started, take_turns, timed, write
from servers import TRIVIAL
from websockets.sync.client import connect

from support.teaching import teach
from surrogym_client.transport import Api, HttpSurrogate, Transport
from surrogym_client.transport.connection import Connection, Retries
from surrogym_client.transport.step_codecs import BinaryForm, Form, JsonForm
from surrogym_client.transport.stream import Stream
from surrogym_sampler.original.classic import pendulum
from surrogym_server.convert import definition_from_spec
from surrogym_server.engine import requests
from surrogym_server.local import LocalSurrogate
from surrogym_server.models.files import from_bytes
from surrogym_shared import frames
from surrogym_shared.port import StepResult, SurrogatePort
from surrogym_shared.wire import OpenSession

SERVERS = str(Path(__file__).with_name("servers.py"))
LANES = (1, 16, 256, 1024)
ROUNDS, CALLS, WARM_UP = 40, 30, 100
SAMPLES = 50
JSON_REPLY_BYTES = {1: 190, 16: 1_600, 256: 22_500, 1024: 89_000}  # about, of a Pendulum step

Measured = dict[str, dict[str, float]]
process_ids: dict[str, int] = {}  # of the servers that run, by their first argument


@contextmanager
def process(*arguments: str, ready: Callable[[], bool]) -> Iterator[None]:
    """A child process for the time of the context, once it is ready."""
    child = subprocess.Popen([sys.executable, SERVERS, *arguments], stdout=subprocess.DEVNULL)
    process_ids[arguments[0]] = child.pid
    try:
        while not ready():
            if child.poll() is not None:
                raise SystemExit(f"{arguments} ended with status {child.returncode}")
            time.sleep(0.05)
        yield
    finally:
        child.terminate()
        child.wait(30)


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@contextmanager
def echo_server() -> Iterator[str]:
    port = free_port()

    def listening() -> bool:
        with socket.socket() as caller:
            return caller.connect_ex(("127.0.0.1", port)) == 0

    with process("echo", str(port), ready=listening):
        yield f"http://127.0.0.1:{port}/echo"


@contextmanager
def surrogym_server() -> Iterator[str]:
    """A server with a learned Pendulum, and the same under the name ``trivial``, whose steps do nothing."""
    with tempfile.TemporaryDirectory() as folder:
        ready = Path(folder, "ready")
        options = ["--port", "0", "--database", str(Path(folder, "db")), "--ready-file", str(ready)]
        with process("surrogym", *options, "--log-level", "warning", ready=ready.exists):
            url = ready.read_text()
            with Api(url) as api:
                teach(api, "pendulum", pendulum(), queries=SAMPLES)
                api.create_surrogate(TRIVIAL, pendulum())
                api.import_model(TRIVIAL, api.export_model("pendulum", 1))
            yield url


def measure(subjects: dict[str, Call], beside: Callable[[str], str | None], quick: bool) -> Measured:
    """p50 and p99 of each, and its ratio to what it is measured beside, a median over rounds that take turns."""
    turns = take_turns({name: timed(call) for name, call in subjects.items()}, 4 if quick else ROUNDS, CALLS, WARM_UP)
    measured = {name: figures(rounds) for name, rounds in turns.items()}
    for name, found in measured.items():
        if (echo := beside(name)) is not None:
            found["ratio"] = ratio(turns[name], turns[echo])
        if name.endswith("stream") and READY in turns:
            found["to library"] = ratio(turns[name], turns[READY])
    return measured


def stepping(port: SurrogatePort, lanes: int, *, compiled: bool = True, **chosen: Any) -> Call:
    """Steps of a new session, by torch where they are not to be compiled."""
    with pytest.MonkeyPatch.context() as patch:
        if not compiled:
            patch.setattr(requests, "in_fastest_form", lambda settings, _: settings)
        session = port.open(OpenSession(num_envs=lanes, seed=0, **chosen)).id
    port.reset(session)
    action = np.random.default_rng(0).uniform(-2, 2, (lanes, 1)).astype(np.float32)
    return lambda: port.step(session, action)


def remote(stack: ExitStack, url: str, surrogate: str, transport: Transport, lanes: int) -> Call:
    return stepping(stack.enter_context(HttpSurrogate(url, surrogate, transport=transport)), lanes)


def request(form: Form, lanes: int) -> bytes:
    """A request as the client would send it."""
    return form.step(9, np.random.default_rng(0).uniform(-2, 2, (lanes, 1)), None, False, frames.Shape(lanes, 3, 1, 3))


def reply_bytes(lanes: int) -> int:
    """Length of a reply of so many lanes of Pendulum."""
    flags, zeros = np.zeros(lanes, dtype=bool), np.zeros(lanes)
    nothing = np.zeros(0, dtype=np.int64), np.zeros((0, 3), dtype=np.float32)
    result = StepResult(np.zeros((lanes, 3)), zeros, flags, flags, *nothing, np.ones(lanes), zeros, None)
    return len(frames.encode(frames.step_reply(9, result)))


def stream_echo(stack: ExitStack, url: str, lanes: int) -> Call:
    """Through the client's own stream."""
    stream = Stream(f"{url}?{reply_bytes(lanes)}", None, 5.0)
    stack.callback(stream.close)
    content = request(BinaryForm(), lanes)
    return lambda: stream.exchange(content, 60.0)


def library_echo(stack: ExitStack, url: str, lanes: int) -> Call:
    """Through the WebSocket library's ready client, which has a thread of its own."""
    connection = stack.enter_context(
        connect(f"{url.replace('http', 'ws', 1)}?{reply_bytes(lanes)}", compression=None, max_size=None)
    )
    content = request(BinaryForm(), lanes)

    def exchange() -> Any:
        connection.send(content)
        return connection.recv()

    return exchange


def http_echo(stack: ExitStack, url: str, content: bytes, size: int) -> Call:
    """Through the client's own HTTP."""
    connection = stack.enter_context(Connection(url, retries=Retries(seconds=0)))
    return lambda: connection.send("POST", f"?{size}", content)


def round_trips(url: str, echo: str, lanes: int, quick: bool) -> Measured:
    with ExitStack() as stack:
        subjects = {
            "echo, WebSocket": stream_echo(stack, echo, lanes),
            READY: library_echo(stack, echo, lanes),
            "trivial, stream": remote(stack, url, TRIVIAL, "stream", lanes),
            "pendulum, stream": remote(stack, url, "pendulum", "stream", lanes),
            "echo, HTTP": http_echo(stack, echo, request(BinaryForm(), lanes), reply_bytes(lanes)),
            "trivial, binary": remote(stack, url, TRIVIAL, "binary", lanes),
            "pendulum, binary": remote(stack, url, "pendulum", "binary", lanes),
            "echo, HTTP JSON": http_echo(stack, echo, request(JsonForm(), lanes), JSON_REPLY_BYTES[lanes]),
            "trivial, json": remote(stack, url, TRIVIAL, "json", lanes),
            "pendulum, json": remote(stack, url, "pendulum", "json", lanes),
        }
        return measure(subjects, lambda name: BESIDE.get(name.partition(", ")[2]), quick)


def in_process(url: str) -> LocalSurrogate:
    with Api(url) as api:
        spec, model = api.surrogate("pendulum").spec, api.export_model("pendulum", 1)
    return LocalSurrogate(spec, from_bytes(definition_from_spec(spec), model))


def throughput(url: str, lanes: int, quick: bool) -> Measured:
    """The same model stepped in this process and over the stream."""
    with ExitStack() as stack:
        subjects = {
            "in process": stepping(in_process(url), lanes),
            "stream": remote(stack, url, "pendulum", "stream", lanes),
        }
        return measure(subjects, lambda _: "in process", quick)


FORMS: dict[str, dict[str, Any]] = {
    "mean": {},
    "penalty": {"penalty": 3.0},
    "function": {"variant": "pathwise"},
    "draws": {"variant": "probabilistic", "particles": 1, "spread": 0.0},
}


def forms(url: str, lanes: int, quick: bool) -> Measured:
    """Steps in this process: compiled, and by torch."""
    port, subjects = in_process(url), {}
    for name, chosen in FORMS.items():
        subjects[f"{name}, torch"] = stepping(port, lanes, compiled=False, **chosen)
        subjects[f"{name}, compiled"] = stepping(port, lanes, compiled=True, **chosen)
    return measure(subjects, lambda name: name.replace("compiled", "torch"), quick)


READY = "echo, WebSocket library"
BESIDE = {"stream": "echo, WebSocket", "binary": "echo, HTTP", "json": "echo, HTTP JSON"}


def show_trips(lanes: int, measured: Measured) -> None:
    for name, found in measured.items():
        against = "".join(f"{found[key]:12.2f}" if key in found else " " * 12 for key in ("ratio", "to library"))
        print(f"{lanes:6} {name:26}{found['p50']:10.0f}{found['p99']:10.0f}{against}")


def show_throughput(lanes: int, measured: Measured) -> None:
    per_second = {name: lanes / found["p50"] * MICROSECONDS for name, found in measured.items()}
    share = 1 / measured["stream"]["ratio"]
    print(f"{lanes:6} " + "".join(f"{name} {rate:12,.0f}   " for name, rate in per_second.items()) + f"{share:6.1%}")


def show_forms(lanes: int, measured: Measured) -> None:
    for name in FORMS:
        ours, theirs = measured[f"{name}, compiled"], measured[f"{name}, torch"]
        print(f"{lanes:6} {name:26}{theirs['p50']:10.0f}{ours['p50']:10.0f}{ours['ratio']:12.2f}")


def main() -> None:
    made = parser(__doc__)
    made.add_argument("--lanes", type=int, nargs="*", choices=LANES, default=LANES)
    options = started(made)
    report: dict[str, Any] = {"round_trip_us": {}, "step_us": {}, "forms_us": {}}
    with echo_server() as echo, surrogym_server() as url:
        print(f"{'N':>6} {'round trip':26}{'p50 us':>10}{'p99 us':>10}{'to echo':>12}{'to library':>12}")
        for lanes in options.lanes:
            report["round_trip_us"][lanes] = round_trips(url, echo, lanes, options.quick)
            show_trips(lanes, report["round_trip_us"][lanes])
        print(f"\n{'N':>6} environment steps per second, and the stream's share of in process")
        for lanes in options.lanes:
            report["step_us"][lanes] = throughput(url, lanes, options.quick)
            show_throughput(lanes, report["step_us"][lanes])
        print(f"\n{'N':>6} {'step in process, p50 us':26}{'torch':>10}{'compiled':>10}{'ratio':>12}")
        for lanes in options.lanes:
            report["forms_us"][lanes] = forms(url, lanes, options.quick)
            show_forms(lanes, report["forms_us"][lanes])
    write(options.out, "step", report)


if __name__ == "__main__":
    main()
