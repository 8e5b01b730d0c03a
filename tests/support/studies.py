"""Stand-ins for the demo in a study of many runs."""

from __future__ import annotations

import json
import sys

from support.metrics import METRICS


def stand_in(seconds=0.0, fails=()):
    """A command that leaves the metrics of its cell, as a demo does."""

    def command(cell, run):
        s = cell.settings
        own = {**METRICS, "task": s.task, "arm": s.arm, "seed": s.seed, "budget": s.real_steps}
        own["specification"] = cell.specification
        script = (
            f"import os, pathlib, sys, time; time.sleep({seconds}); "
            f"sys.exit('error: no luck') if {s.seed in fails} else None; "
            f"run = pathlib.Path({str(run)!r}); run.mkdir(parents=True); "
            f"assert os.environ['OMP_NUM_THREADS'] == '1'; "
            f"(run / 'metrics.json').write_text({json.dumps(own)!r})"
        )
        return [sys.executable, "-c", script]

    return command


def ignore(progress):
    """Tell nobody how far a study is."""
