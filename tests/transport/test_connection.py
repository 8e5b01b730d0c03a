"""What the network does to a request: lost replies, time-outs, dead and foreign servers. On real sockets."""

import gzip
import pickle
import socket
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from http.server import BaseHTTPRequestHandler
from pathlib import Path

import pytest

from support.scripted_server import lost_reply, problem, reply, scripted_server
from surrogym_client import errors
from surrogym_client.transport.connection import Connection, Retries, Timeouts
from surrogym_shared.codes import Code

QUICK = Retries(seconds=2.0, first_delay=0.01, longest_delay=0.05)
NEVER = Retries(seconds=0.0)
BODY = b'{"seq":1}'


def unused_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@pytest.mark.parametrize("failure", [lost_reply, problem(Code.UNAVAILABLE), problem(Code.TOO_MANY_REQUESTS)])
def test_a_failed_request_is_sent_again_unchanged(failure):
    with (
        scripted_server(failure, failure, reply("done")) as server,
        Connection(server.url, retries=QUICK) as c,
    ):
        assert c.send("POST", "/x", BODY) == b"done"
    assert [r.body for r in server.received] == [BODY] * 3


def test_unrepeatable_requests_are_not_sent_again_after_a_lost_reply():
    with scripted_server(lost_reply) as server, Connection(server.url, retries=QUICK) as connection:
        with pytest.raises(errors.ServerUnreachable, match="was lost"):
            connection.send("POST", "/x", BODY, repeatable=False)
        assert len(server.received) == 1


def test_unrepeatable_requests_are_sent_again_after_a_refusal():
    script = [problem(Code.UNAVAILABLE), reply("done")]
    with scripted_server(*script) as server, Connection(server.url, retries=QUICK) as connection:
        assert connection.send("POST", "/x", BODY, repeatable=False) == b"done"


def test_a_late_reply_never_answers_a_later_request():
    script = [reply("late", delay=0.4), reply("second"), reply("third")]
    with scripted_server(*script) as server, Connection(server.url, retries=QUICK) as connection:
        assert connection.send("POST", "/x", b"1", timeout=0.1) == b"second"
        threading.Event().wait(0.5)
        assert connection.send("POST", "/x", b"2") == b"third"


def test_a_reply_later_than_its_timeout_raises_request_timeout():
    with (
        scripted_server(reply("late", delay=0.3)) as server,
        Connection(server.url, retries=NEVER) as connection,
        pytest.raises(errors.RequestTimeout, match="did not answer in time"),
    ):
        connection.send("GET", "/x", timeout=0.05)


def test_the_error_for_an_unreachable_server_contains_its_address():
    url = f"http://127.0.0.1:{unused_port()}"
    with Connection(url, retries=NEVER) as connection, pytest.raises(errors.ServerUnreachable, match=url):
        connection.send("GET", "/x")


def test_a_connection_waits_for_a_server_that_starts_late():
    port = unused_port()
    listening = socket.socket()

    def serve_once() -> None:
        threading.Event().wait(0.2)
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listening.bind(("127.0.0.1", port))
        listening.listen()
        peer, _ = listening.accept()
        with peer:
            peer.recv(65536)
            peer.sendall(b"HTTP/1.1 200 OK\r\nContent-Length: 2\r\nConnection: close\r\n\r\nup")

    thread = threading.Thread(target=serve_once)
    thread.start()
    with listening, Connection(f"http://127.0.0.1:{port}", retries=Retries(seconds=20)) as connection:
        assert connection.send("GET", "/x") == b"up"
        thread.join()


def test_an_error_reply_is_raised_at_once_as_its_own_exception():
    refusal = problem(Code.SPEC_CONFLICT, "another spec")
    with scripted_server(refusal) as server, Connection(server.url, retries=QUICK) as connection:
        with pytest.raises(errors.SpecConflict, match="another spec"):
            connection.send("POST", "/x", BODY)
        assert len(server.received) == 1


@pytest.mark.parametrize("status", [200, 302, 307, 404])
def test_a_reply_from_an_http_server_other_than_surrogym_is_refused(status: int):
    """A login page or a redirect must not be exported as samples."""
    with (
        scripted_server(reply("<html>", status, "text/html")) as server,
        Connection(server.url) as connection,
        pytest.raises(errors.ProtocolMismatch, match=rf"expected a Surrogym server.*{status}.*text/html"),
    ):
        connection.send("GET", "/x")


def test_a_connection_retries_after_a_bad_gateway_reply():
    script = [reply("<html>", 502, "text/html"), reply("done")]
    with scripted_server(*script) as server, Connection(server.url, retries=QUICK) as connection:
        assert connection.send("GET", "/x") == b"done"


@pytest.mark.parametrize("url", ["pendulum", "ftp://host", "http://", "http://host:port", "host:8000"])
def test_an_invalid_server_address_is_refused(url: str):
    with pytest.raises(errors.ServerUnreachable, match=r"expected a server address like http://127.0.0.1:8000, got"):
        Connection(url)


def test_address_and_token_default_to_environment_variables(monkeypatch: pytest.MonkeyPatch):
    with scripted_server(reply("done")) as server:
        monkeypatch.setenv("SURROGYM_URL", server.url + "/")
        monkeypatch.setenv("SURROGYM_TOKEN", "from-environment")
        for token, expected in ((None, "Bearer from-environment"), ("own", "Bearer own")):
            with Connection(token=token) as connection:
                connection.send("GET", "/x")
            assert server.received[-1].headers["Authorization"] == expected
        assert server.received[-1].path == "/x"


def test_the_token_can_be_read_from_a_file(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    (tmp_path / "token").write_text("train:from-a-file\n")
    monkeypatch.setenv("SURROGYM_TOKEN_FILE", str(tmp_path / "token"))
    for token, expected in (("", "from-a-file"), ("from-environment", "from-environment")):
        monkeypatch.setenv("SURROGYM_TOKEN", token)
        with scripted_server(reply("done")) as server, Connection(server.url) as connection:
            connection.send("GET", "/x")
            assert server.received[-1].headers["Authorization"] == f"Bearer {expected}"


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "can't be read: No such file or directory"),
        ("", "expected lines of the form role:token, got an empty file"),
        ("read:one-secret\ntrain:two-secret", "expected one token, got 2"),
        ("a-secret\n" + "x" * 2**17, "expected at most 65536 bytes, got more"),
        ("king:a-secret", "a token's role: expected one of read, train, sample, admin before the colon, got another"),
    ],
)
def test_a_token_file_without_a_token_is_refused(monkeypatch, tmp_path: Path, content: str | None, message: str):
    file = tmp_path / "token"
    if content is not None:
        file.write_text(content)
    monkeypatch.delenv("SURROGYM_TOKEN", raising=False)
    monkeypatch.setenv("SURROGYM_TOKEN_FILE", str(file))
    with pytest.raises(errors.UnusableToken, match=message) as refusal:
        Connection()
    assert str(file) in str(refusal.value)
    assert "secret" not in str(refusal.value)


def test_the_default_server_address_is_loopback(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.delenv("SURROGYM_URL", raising=False)
    assert Connection().url == "http://127.0.0.1:8000"


def test_requests_to_loopback_ignore_proxy_settings(monkeypatch: pytest.MonkeyPatch):
    for name in ("HTTP_PROXY", "http_proxy", "ALL_PROXY", "all_proxy"):
        monkeypatch.setenv(name, f"http://127.0.0.1:{unused_port()}")
    for name in ("NO_PROXY", "no_proxy"):
        monkeypatch.delenv(name, raising=False)
    with scripted_server(reply("done")) as server, Connection(server.url, retries=NEVER) as connection:
        assert connection.send("GET", "/x") == b"done"


def test_a_pickled_connection_reconnects():
    with (
        scripted_server(reply("done")) as server,
        Connection(server.url, "secret", Timeouts(step=3)) as original,
    ):
        with pickle.loads(pickle.dumps(original)) as again:
            assert again.send("GET", "/x") == b"done"
            assert again.timeouts == Timeouts(step=3)
        assert server.received[-1].headers["Authorization"] == "Bearer secret"


def test_a_connection_that_opens_again_does_not_read_the_certificates_again(monkeypatch: pytest.MonkeyPatch):
    """Each session that a program opened alone took 20 ms for them."""
    with scripted_server(reply("done")) as server, Connection(server.url, retries=NEVER) as connection:
        monkeypatch.setattr("httpx.create_ssl_context", None)
        connection.close()
        assert connection.send("GET", "/x") == b"done"


def test_a_connection_closed_by_another_thread_leaves_no_socket_open():
    """A sampler that is stopped still waits for queries in its other thread."""
    with scripted_server(reply("first"), reply("late", delay=0.3), reply("later")) as server:
        connection = Connection(server.url, retries=NEVER)
        connection.send("GET", "/x")
        with ThreadPoolExecutor(1) as pool:
            under_way = pool.submit(connection.send, "GET", "/x")
            while len(server.received) < 2:
                time.sleep(0.005)
            connection.close()
            assert under_way.result() == b"late"
        assert connection._client.is_closed
        assert connection.send("GET", "/x") == b"later"
        connection.close()
        assert connection._client.is_closed


def test_retry_delays_grow_to_their_limit_and_end_after_the_time_budget():
    pauses = Retries(seconds=0.4, first_delay=0.01, longest_delay=0.04).delays()
    taken = [next(pauses) for _ in range(6)]
    limits = [0.01, 0.02, 0.04, 0.04, 0.04, 0.04]
    assert all(limit / 2 <= pause <= limit for pause, limit in zip(taken, limits, strict=True))
    threading.Event().wait(0.5)
    assert next(pauses, None) is None
    assert list(NEVER.delays()) == []


def test_a_server_address_with_a_password_is_refused_without_showing_it():
    """It would be written into cards and reports, and sent in the place of the token."""
    with pytest.raises(errors.ServerUnreachable, match="without user and password") as refused:
        Connection("http://bob:hunter2@127.0.0.1:1", None)
    assert "hunter2" not in str(refused.value)


@pytest.mark.parametrize("token", ["a-secret\nX: y", "a-secret\t", "geheim-ü", "a-secret ", "a\udcffsecret"])
def test_a_token_that_no_header_can_contain_is_refused_without_showing_it(token: str):
    with pytest.raises(errors.UnusableToken, match="a token: expected letters, digits and signs of ASCII") as refusal:
        Connection("http://127.0.0.1:1", token)
    assert "secret" not in str(refusal.value)
    assert "geheim" not in str(refusal.value)


def test_an_unusable_file_of_certificates_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    for file, reason in ((tmp_path / "missing.pem", "No such file"), (Path(__file__), "no certificate")):
        monkeypatch.setenv("SSL_CERT_FILE", str(file))
        with pytest.raises(errors.UnusableCertificates, match=rf"SSL_CERT_FILE: expected .*{file.name}.*{reason}"):
            Connection("http://127.0.0.1:1")


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (gzip.compress(bytes(2 * 10**6)), r"expected an answer of at most 1000000 bytes from http.*, got more"),
        (b"no gzip", r"expected an answer that can be decompressed from http"),
    ],
)
def test_an_answer_that_inflates_without_end_or_not_at_all_is_refused(
    monkeypatch: pytest.MonkeyPatch, content: bytes, says: str
):
    """A few megabytes of gzip filled the client's memory; what is no gzip gave a traceback."""
    monkeypatch.setattr("surrogym_client.transport.connection.MOST_ANSWER", 10**6)

    def zipped(handler: BaseHTTPRequestHandler) -> None:
        handler.send_response(200)
        handler.send_header("Content-Encoding", "gzip")
        handler.send_header("Content-Length", str(len(content)))
        handler.end_headers()
        handler.wfile.write(content)

    with (
        scripted_server(zipped) as server,
        Connection(server.url, retries=QUICK) as connection,
        pytest.raises(errors.ProtocolMismatch, match=says),
    ):
        connection.send("GET", "/x")
