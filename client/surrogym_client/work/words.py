"""Text about jobs."""

from __future__ import annotations

from surrogym_shared import wire


def words_of_task(task: wire.Task) -> str:
    """Describe what a job asks for."""
    if isinstance(task, wire.TrainTask):
        steps = "" if task.steps is None else f", {task.steps} virtual steps"
        by = "" if task.algorithm is None else f" by {task.algorithm}"
        return f"train{by}, seed {task.seed}{steps}{', quick' if task.preset == 'quick' else ''}"
    beside = "" if task.compare is None else f", compared with {task.compare} actions"
    return f"evaluate version {task.policy} in {task.episodes} real episodes{beside}"
