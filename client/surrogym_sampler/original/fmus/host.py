"""The program that loads an FMU's native code: ``python -m surrogym_sampler.original.fmus.host``.

It answers one line of JSON with one line of JSON, as any program of ``executables`` does, until its input ends. What
the native code prints goes to standard error.
"""

from __future__ import annotations

import json
import math
import os
import secrets
import shutil
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, TextIO

from surrogym_sampler.original.fmus.instance import Broken, Instance, Refused, Saved, Start, Typed

KEPT = 256  # saved states in memory, if the FMU can't give them as bytes; the oldest goes first
WATCH_SECONDS = 1.0  # how often this program looks whether its parent still exists
Fields = dict[str, Any]


class Host:
    """The requests, and what they need between them."""

    def __init__(self) -> None:
        self._instance: Instance | None = None
        self._directory = ""
        self._inputs: list[Typed] = []
        self._reads: list[Typed] = []
        self._names: list[str] = []  # of what is read
        self._serializes = False
        self._kept: dict[int, Saved] = {}
        self._saved = secrets.randbits(60)  # key of the last state; another process's keys don't fit here
        self.requests: dict[str, Callable[[Fields], Fields]] = {
            "open": self._open,
            "initialise": self._initialise,
            "step": self._step,
            "save": self._save,
            "restore": self._restore,
            "close": self._close,
        }

    def clear(self) -> None:
        """Delete what was extracted, if the parent has ended and can't."""
        if self._directory:
            shutil.rmtree(self._directory, ignore_errors=True)

    @property
    def _open_instance(self) -> Instance:
        if self._instance is None:
            raise Refused("no FMU is open")
        return self._instance

    def _open(self, fields: Fields) -> Fields:
        self._directory = fields["directory"]
        self._inputs = [(kind, reference) for kind, reference in fields["inputs"]]
        self._reads = [(kind, reference) for _, kind, reference in fields["reads"]]
        self._names = [name for name, _, _ in fields["reads"]]
        self._serializes = fields["serializes"]
        try:
            self._instance = Instance(
                fields["version"],
                fields["directory"],
                fields["library"],
                fields["identifier"],
                fields["token"],
                fields["step"],
                fields["only_once"],
            )
        except Exception as error:  # fmpy raises a plain Exception, ctypes an AttributeError
            raise Refused(f"the FMU's native code can't be loaded: {error}") from error
        return {}

    def _initialise(self, fields: Fields) -> Fields:
        start: list[Start] = [(kind, reference, value) for kind, reference, value in fields["start"]]
        self._open_instance.initialise(start)
        return self._values()

    def _step(self, fields: Fields) -> Fields:
        over = self._open_instance.step(self._inputs, fields["action"])
        return {**self._values(), "over": over}

    def _save(self, fields: Fields) -> Fields:
        instance = self._open_instance
        saved = instance.save()
        if self._serializes:
            Path(fields["file"]).write_bytes(instance.as_bytes(saved))
            instance.forget(saved)
            return {"steps": saved.steps, "key": 0}
        if len(self._kept) >= KEPT:
            instance.forget(self._kept.pop(min(self._kept)))
        self._saved += 1
        self._kept[self._saved] = saved
        return {"steps": saved.steps, "key": self._saved}

    def _restore(self, fields: Fields) -> Fields:
        instance, key = self._open_instance, fields["key"]
        if key:
            if key not in self._kept:
                raise Refused("this saved state is no longer in memory, and the FMU can't give it as bytes")
            instance.restore(self._kept[key])
            return self._values()
        saved = instance.from_bytes(Path(fields["file"]).read_bytes(), fields["steps"])
        instance.restore(saved)
        instance.forget(saved)
        return self._values()

    def _close(self, fields: Fields) -> Fields:
        del fields
        if self._instance is not None:
            self._instance.close()
        return {}

    def _values(self) -> Fields:
        values = self._open_instance.read(self._reads)
        named = dict(zip(self._names, values, strict=True))  # a state that is an output too is read twice
        wrong = [f"{name} is {value}" for name, value in named.items() if not math.isfinite(value)]
        if wrong:
            raise Refused(f"expected finite values of the FMU, but {', '.join(wrong)}")
        return {"values": values}


def serve(host: Host, source: TextIO, answers: TextIO) -> None:
    """Answer every line until the input ends or the host is asked to close."""
    for line in source:
        asked = json.loads(line)
        answer: Fields = {"id": asked["id"]}
        try:
            answer["result"] = host.requests[asked["method"]](asked)
        except (Refused, Broken) as error:
            ended = isinstance(error, Broken)
            answer |= {"error": str(error), "code": "broken" if ended else "failed"}
        else:
            ended = asked["method"] == "close"
        print(json.dumps(answer, allow_nan=False), file=answers, flush=True)
        if ended:
            return
    host.clear()


def _end_with_parent(host: Host, parent: int) -> None:
    """End this process soon after its parent, even in the middle of a step."""
    while os.getppid() == parent:
        time.sleep(WATCH_SECONDS)
    host.clear()
    os._exit(1)


def main() -> None:
    """Keep standard output for answers alone, and serve."""
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    host = Host()
    threading.Thread(target=_end_with_parent, args=(host, os.getppid()), daemon=True).start()
    serve(host, sys.stdin, answers)
    os._exit(0)  # without the exit handlers of native code, which may hang


if __name__ == "__main__":
    main()
