"""The demo from its first process to its run folder."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from surrogym.demo.judging import judge
from surrogym.demo.learning import SurrogateRun
from surrogym.demo.processes import Children, RunFailed
from surrogym.demo.report import metrics_of
from surrogym.demo.settings import DemoSettings
from surrogym_client.runtime.lifetime import terminations_as_interrupts
from surrogym_client.runtime.versions import commit
from surrogym_shared.terminal import on_interrupt, say


def run_demo(
    settings: DemoSettings,
    begin: Callable[..., SurrogateRun],
    out: Path | None,
    tell: Callable[[dict[str, Any], Path], None],
    *,
    quiet: bool,
) -> None:
    """Run a demo: learn a policy, evaluate it, and write metrics and data into the run folder.

    Args:
        settings: settings of the demo.
        begin: starts the run that learns the policy, from the settings, its folder and its child processes.
        out: an empty folder for the results; None makes one.
        tell: called at the end with the metrics and the run folder.
        quiet: whether progress is hidden.

    Raises:
        RunFailed: the folder is not empty, or a process failed; the message has its last output and its log file.
        SurrogymClientError: the server refused, or the design failed.
    """
    started, code = time.monotonic(), commit()
    folder = _empty_folder(
        out or (Path("runs") / f"{settings.run_name}-seed{settings.seed}-{time.strftime('%Y%m%d-%H%M%S')}")
    )
    with terminations_as_interrupts(), on_interrupt(partial(_what_stays, folder)), Children(folder) as children:
        run = begin(settings, folder, children, quiet=quiet)
        learned = run.learn()
        judging = time.monotonic()
        judgement = judge(settings, learned.policy, quiet=quiet)
        keeping = time.monotonic()
        run.keep(judgement)
        now = time.monotonic()
        seconds = {"evaluate": keeping - judging, "report": now - keeping, "total": now - started}
        metrics = metrics_of(settings, learned, judgement, learned.seconds | seconds)
        metrics["commit"] = code if code == commit() else f"{code} to {commit()}"
        (folder / "metrics.json").write_text(json.dumps(metrics, indent=2) + "\n", encoding="utf-8")
        tell(metrics, folder)
        if settings.keep:
            run.linger()
        elif (database := _database(folder)).exists():
            say(f"next: surrogym serve --database {database}, and look at its page", quiet=quiet)


def _empty_folder(folder: Path) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    if any(folder.iterdir()):
        raise RunFailed(f"expected an empty run folder, got {folder}, which holds files already: name another by --out")
    return folder.resolve()


def _what_stays(folder: Path) -> str:
    """Describe the results that remain in the run folder after an interruption."""
    database, policy = _database(folder), folder / "policy.zip"
    kept = [f"the real samples (surrogym serve --database {database})"] if database.exists() else []
    kept += [f"the policy so far ({policy})"] if policy.exists() else []
    return f"interrupted; all processes have ended; {folder} keeps {' and '.join(kept) or 'only logs'}"


def _database(folder: Path) -> Path:
    return folder / "surrogym.db"
