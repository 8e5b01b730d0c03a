"""Cells as tasks of a Ray cluster. Each takes one CPU, on whatever machine has one free."""

from __future__ import annotations

import io
import os
import subprocess
import tarfile
import tempfile
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from surrogym_client.experiments.reproduce.cells import ONE_THREAD, Cell, Command, Places, Run, failed, row_of_run
from surrogym_client.experiments.reproduce.rows import Row

RETRIES = 1  # of a run whose process or machine died


@dataclass(frozen=True)
class Ran:
    """What a run left on its machine: exit code, log, and run folder as a tar archive."""

    code: int
    log: bytes = field(repr=False)
    archive: bytes = field(repr=False)


class RayRun(Run):
    """A cell that runs in the cluster. Its log and its run folder come here when it is over."""

    def __init__(self, cell: Cell, folder: Path, command: Command) -> None:
        import ray

        self.cell = cell
        self._places = Places.of(cell, folder)
        self._ray: Any = ray
        self._asked = ray.remote(num_cpus=1, max_retries=RETRIES)(_ran).remote(cell, command)

    @property
    def over(self) -> bool:
        done, _ = self._ray.wait([self._asked], timeout=0)
        return bool(done)

    def row(self) -> Row:
        try:
            ran: Ran = self._ray.get(self._asked)
        except self._ray.exceptions.RayError as error:
            last = (str(error).strip().splitlines() or [type(error).__name__])[-1]
            return failed(self.cell, f"the process or machine of the run died: {last}")
        self._places.log.write_bytes(ran.log)
        with tarfile.open(fileobj=io.BytesIO(ran.archive)) as archive:
            archive.extractall(self._places.run, filter="data")
        return row_of_run(self.cell, ran.code, self._places)

    def end(self) -> None:
        with suppress(self._ray.exceptions.RayError, ValueError):
            self._ray.cancel(self._asked, force=True)

    def wait(self) -> None:
        with suppress(self._ray.exceptions.RayError):
            self._ray.get(self._asked, timeout=0)


def _ran(cell: Cell, command: Command) -> Ran:
    """Run a cell, in a process of the cluster. The demo ends with this process."""
    with tempfile.TemporaryDirectory(prefix="surrogym-") as folder:
        run, log = Path(folder) / "run", Path(folder) / "log"
        with log.open("wb") as file:
            code = subprocess.run(
                command(cell, run),
                stdin=subprocess.DEVNULL,
                stdout=file,
                stderr=file,
                env=os.environ | ONE_THREAD,
                check=False,
            ).returncode
        archive = io.BytesIO()
        with tarfile.open(fileobj=archive, mode="w:gz") as tar:
            if run.exists():
                tar.add(run, arcname=".")
        return Ran(code, log.read_bytes(), archive.getvalue())
