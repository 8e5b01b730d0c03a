"""The program that loads an FMU's native code: ``python -m surrogym_sampler.original.fmus.host``.

It answers each line of JSON with a line of JSON, by the protocol of ``executables``, until its input ends. What the
native code prints goes to standard error.
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

KEPT = 256  # number of saved states in memory, if the FMU can't give them as bytes; the oldest is dropped
WATCH_SECONDS = 1.0  # seconds between two checks of whether the parent process still exists
Fields = dict[str, Any]


class Host:
    """The methods with which an FMU's own process answers the requests of its parent process, and the state that they
    share."""

    def __init__(self) -> None:
        self._instance: Instance | None = None
        self._directory = ""
        self._inputs: list[Typed] = []
        self._reads: list[Typed] = []
        self._names: list[str] = []  # names of the variables that are read
        self._serializes = False
        self._kept: dict[int, Saved] = {}
        # key of the last saved state; the first is random, so that keys of another process are not valid here
        self._saved = secrets.randbits(60)
        self.requests: dict[str, Callable[[Fields], Fields]] = {
            "open": self._open,
            "initialise": self._initialise,
            "step": self._step,
            "save": self._save,
            "restore": self._restore,
            "close": self._close,
        }

    def clear(self) -> None:
        """Delete the extracted files, for a parent that has ended without deleting them."""
        if self._directory:
            shutil.rmtree(self._directory, ignore_errors=True)

    @property
    def _open_instance(self) -> Instance:
        if self._instance is None:
            raise Refused("expected an open FMU, got none: send the request open first")
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
            raise Refused(f"the FMU's native code can't be loaded: {error}; export the FMU for this machine") from error
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
                raise Refused(
                    "the saved state was dropped from memory, and the FMU can't give states as bytes: restore a newer "
                    "state"
                )
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
        # a dictionary, because a variable that is both state and output is read twice but reported once
        named = dict(zip(self._names, values, strict=True))
        wrong = [f"{name} is {value}" for name, value in named.items() if not math.isfinite(value)]
        if wrong:
            raise Refused(
                f"expected finite values from the FMU, got {', '.join(wrong)}: narrow the actions or the states"
            )
        return {"values": values}


def serve(host: Host, source: TextIO, answers: TextIO) -> None:
    """Answer every line of the source until the source ends, a request asks to close, or the native code breaks."""
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
    """Run the host. The descriptor of standard output is kept for answers; whatever else is printed goes to standard
    error."""
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    host = Host()
    threading.Thread(target=_end_with_parent, args=(host, os.getppid()), daemon=True).start()
    serve(host, sys.stdin, answers)
    os._exit(0)  # skips the exit handlers of the native code, which may hang


if __name__ == "__main__":
    main()
