"""Delivery of reports of drift to the address that the server's operator set, without delaying the request that
reports one."""

from __future__ import annotations

import logging
import queue
import threading
import time
from urllib.parse import urlsplit

from surrogym_server.storage.records import JSON

logger = logging.getLogger(__name__)

WAITING = 100  # at most this many messages wait for delivery; further ones are dropped, and the log says so
ANSWER_SECONDS = 10.0
PAUSES = (1.0, 5.0, 30.0, 120.0)  # seconds between two attempts to deliver the same message


class Webhook:
    """Posts messages as JSON to one address, one after the other, in a thread of its own.

    A message is delivered if the receiver answers with a status from 200 to 299. Redirections are not followed. A
    message that five attempts did not deliver, or that still waits when the server stops, is lost; the report of drift
    itself stays in the database.
    """

    def __init__(self, url: str) -> None:
        self._url = url
        self._host = urlsplit(url).hostname  # the log names no more of the address, because a path may be a secret
        self._messages: queue.Queue[JSON] = queue.Queue(WAITING)
        threading.Thread(target=self._deliver_all, name="surrogym-webhook", daemon=True).start()

    def post(self, message: JSON) -> None:
        """Deliver a message later."""
        try:
            self._messages.put_nowait(message)
        except queue.Full:
            logger.error("webhook: %s messages wait for %s; one more was dropped", WAITING, self._host)

    def _deliver_all(self) -> None:
        while True:
            self._deliver(self._messages.get())

    def _deliver(self, message: JSON) -> None:
        import httpx  # imported on first use, so that a server without a webhook starts sooner

        for pause in (*PAUSES, None):
            try:
                # only the status is read, because the content of an answer may have no end
                with httpx.stream("POST", self._url, json=message, timeout=ANSWER_SECONDS) as answer:
                    answer.raise_for_status()
            except httpx.HTTPStatusError as error:
                fault = f"it answered with status {error.response.status_code}"
            except Exception as error:  # a fault of one message must not end the thread
                fault = type(error).__name__
            else:
                return
            if pause is not None:
                time.sleep(pause)
        logger.error("webhook: a report of drift was not delivered to %s: %s", self._host, fault)
