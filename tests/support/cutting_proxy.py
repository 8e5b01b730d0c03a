"""A TCP proxy that cuts connections: after so many bytes of replies, the last of them lost."""

from __future__ import annotations

import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field

CHUNK = 65_536


@dataclass
class CuttingProxy:
    """``budgets`` are the bytes of reply that each connection may carry, in the order they come; None is for ever."""

    url: str
    budgets: Iterator[int | None]
    cuts: int = 0
    lock: threading.Lock = field(default_factory=threading.Lock)

    def next_budget(self) -> int | None:
        with self.lock:
            return next(self.budgets, None)


@contextmanager
def cutting_proxy(target: str, budgets: Iterator[int | None]) -> Iterator[CuttingProxy]:
    """A proxy to the server at a URL, for the time of the context."""
    host, _, port = target.removeprefix("http://").rpartition(":")
    with socket.create_server(("127.0.0.1", 0)) as listener:
        proxy = CuttingProxy(f"http://127.0.0.1:{listener.getsockname()[1]}", budgets)
        acceptor = threading.Thread(target=_accept, args=(proxy, listener, (host, int(port))))
        acceptor.start()
        try:
            yield proxy
        finally:
            listener.shutdown(socket.SHUT_RDWR)
            acceptor.join()


def _accept(proxy: CuttingProxy, listener: socket.socket, target: tuple[str, int]) -> None:
    threads: list[threading.Thread] = []
    with suppress(OSError):
        while True:
            near, _ = listener.accept()
            far = socket.create_connection(target)
            for end in (near, far):
                end.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            budget = proxy.next_budget()
            threads.append(threading.Thread(target=_requests, args=(near, far)))
            threads.append(threading.Thread(target=_replies, args=(proxy, near, far, budget)))
            for thread in threads[-2:]:
                thread.start()
    for thread in threads:
        thread.join()


def _requests(near: socket.socket, far: socket.socket) -> None:
    with suppress(OSError):
        while data := near.recv(CHUNK):
            far.sendall(data)
        far.shutdown(socket.SHUT_WR)


def _replies(proxy: CuttingProxy, near: socket.socket, far: socket.socket, budget: int | None) -> None:
    carried = 0
    with suppress(OSError), near, far:
        while data := far.recv(CHUNK):
            carried += len(data)
            if budget is not None and carried > budget:
                with proxy.lock:
                    proxy.cuts += 1
                near.shutdown(socket.SHUT_RDWR)
                return
            near.sendall(data)
