"""A TCP proxy of one fault: connections whose replies never come, come late, or come to requests sent twice.

Connections that are cut are ``cutting_proxy``'s.
"""

from __future__ import annotations

import random
import re
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from typing import Literal

Fault = Literal["drop", "delay", "duplicate"]
CHUNK = 65_536
LENGTH = re.compile(rb"\r\ncontent-length: *(\d+)", re.IGNORECASE)


@dataclass
class FaultProxy:
    """``share`` of the replies (or requests, if duplicated) meets the fault; ``count`` says how many did."""

    fault: Fault
    share: float
    longest_delay: float
    target: tuple[str, int]
    url: str = ""
    count: int = 0
    source: random.Random = field(default_factory=lambda: random.Random(0))
    lock: threading.Lock = field(default_factory=threading.Lock)

    def strikes(self, fault: Fault) -> bool:
        with self.lock:
            struck = self.fault == fault and self.source.random() < self.share
            self.count += struck
            return struck

    def pause(self) -> None:
        with self.lock:
            seconds = self.source.uniform(0, self.longest_delay)
        time.sleep(seconds)


@contextmanager
def fault_proxy(target: str, fault: Fault, share: float, longest_delay: float = 0.0) -> Iterator[FaultProxy]:
    """A proxy to the server at a URL, for the time of the context."""
    host, _, port = target.removeprefix("http://").rpartition(":")
    proxy = FaultProxy(fault, share, longest_delay, (host, int(port)))
    with socket.create_server(("127.0.0.1", 0)) as listener:
        proxy.url = f"http://127.0.0.1:{listener.getsockname()[1]}"
        acceptor = threading.Thread(target=_accept, args=(proxy, listener))
        acceptor.start()
        try:
            yield proxy
        finally:
            listener.shutdown(socket.SHUT_RDWR)
            acceptor.join()


def _accept(proxy: FaultProxy, listener: socket.socket) -> None:
    threads: list[threading.Thread] = []
    with suppress(OSError):
        while True:
            near, _ = listener.accept()
            far = socket.create_connection(proxy.target)
            for end in (near, far):
                end.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            threads.append(threading.Thread(target=_requests, args=(proxy, near, far)))
            threads.append(threading.Thread(target=_replies, args=(proxy, near, far)))
            for thread in threads[-2:]:
                thread.start()
    for thread in threads:
        thread.join()


def _requests(proxy: FaultProxy, near: socket.socket, far: socket.socket) -> None:
    with suppress(OSError):
        while data := near.recv(CHUNK):
            if proxy.fault == "duplicate":
                while not _whole(data):
                    data += near.recv(CHUNK)
                if _http(data) and proxy.strikes("duplicate"):
                    _send_beside(proxy.target, data)
            far.sendall(data)
        far.shutdown(socket.SHUT_WR)


def _replies(proxy: FaultProxy, near: socket.socket, far: socket.socket) -> None:
    dropped = False
    with suppress(OSError), near, far:
        while data := far.recv(CHUNK):
            dropped = dropped or proxy.strikes("drop")  # nor does anything behind it come
            if proxy.strikes("delay"):
                proxy.pause()
            if not dropped:
                near.sendall(data)


def _http(data: bytes) -> bool:
    """Whether it is a whole request; what runs over a stream is none."""
    return b"\r\n\r\n" in data and data[:4] in (b"POST", b"GET ", b"DELE") and b"upgrade: websocket" not in data.lower()


def _whole(data: bytes) -> bool:
    head, end, body = data.partition(b"\r\n\r\n")
    length = LENGTH.search(head)
    return not (data[:4] == b"POST" and (not end or (length is not None and len(body) < int(length[1]))))


def _send_beside(target: tuple[str, int], data: bytes) -> None:
    """The same bytes over a connection of their own, carried out before the ones that follow."""
    with socket.create_connection(target) as other:
        other.sendall(data)
        other.recv(CHUNK)
