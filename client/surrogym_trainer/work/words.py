"""Text about the tasks of jobs."""

from __future__ import annotations

from surrogym_shared import wire
from surrogym_shared.words import counted


def words_of_task(task: wire.Task) -> str:
    """Return a sentence about the task of a job."""
    if isinstance(task, wire.TrainTask):
        steps = "" if task.steps is None else f", {task.steps} virtual steps"
        by = "" if task.algorithm is None else f" by {task.algorithm}"
        return f"train{by}, seed {task.seed}{steps}{', quick' if task.preset == 'quick' else ''}"
    others = [
        *([] if task.compare is None else [f"{task.compare} actions"]),
        *(["the reference controller"] if task.reference else []),
    ]
    beside = f", compared with {' and '.join(others)}" if others else ""
    video = ", with a video" if task.video else ""
    return f"evaluate version {task.policy} in {counted(task.episodes, 'real episode')}{beside}{video}"
