"""The experiments of the paper's section 5: designs, policies and real episodes, as stages that can be resumed.

A cell is one design with one seed. All that it leaves is in a folder of its own: results of its stages, policies and
the database of its server. So it may run on any machine. A stage with a result is not run again, and the database keeps
the real steps of an interrupted design.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any

from surrogym.demo.processes import Children, await_file
from surrogym_client.runtime.versions import commit
from surrogym_client.surrogates.waiting import wait_for_design
from surrogym_client.transport.api import Api
from surrogym_client.transport.connection import Retries
from surrogym_client.transport.http_surrogate import HttpSurrogate
from surrogym_lab.cluster import Task, TaskFailed, run_tasks
from surrogym_lab.reproduce.markdown import markdown
from surrogym_lab.reproduce.paper_cases import Cell
from surrogym_lab.reproduce.paper_measures import Unseen, confidences, run_variation, some
from surrogym_lab.reproduce.paper_table import per_seed, table
from surrogym_sampler.original import make
from surrogym_sampler.queries.settings import Outcome, SamplerSettings
from surrogym_sampler.queries.worker import Sampler
from surrogym_shared.wire import Query
from surrogym_trainer.policies.files import load_policy
from surrogym_trainer.training import TrainProgress, TrainSettings, train
from surrogym_trainer.training.search import REFERENCE

PATIENCE_SECONDS = 3_600.0
DATABASE = "surrogym.db"

Say = Callable[[float, str], None]  # share of the whole, a few words
Row = dict[str, Any]


def run_cells(todo: Sequence[Cell], folder: Path, say: Say) -> list[Row]:
    """Run the cells one after the other, and return their results. Finished stages are read. After each cell, tables
    and figures of all seeds that are complete are written.

    Raises:
        RunFailed: the server did not start.
        SurrogymClientError: it refused, or a design failed.
    """
    rows: list[Row] = []
    for number, cell in enumerate(todo):

        def tell(share: float, words: str, number: int = number, cell: Cell = cell) -> None:
            say((number + share) / len(todo), f"{number + 1} of {len(todo)}, {_words(cell)}: {words}")

        if not _is_done(cell, folder):
            _run(cell, folder, tell)
        if [cell.seed] != [following.seed for following in todo[number + 1 : number + 2]]:
            rows = _write_results(todo[: number + 1], folder)
    return rows


def run_on_ray(todo: Sequence[Cell], folder: Path, jobs: int, say: Say) -> tuple[list[Row], list[str]]:
    """Run cells in the Ray cluster that this process is connected to, ``jobs`` at once. A cell continues from its files
    in the folder, and what it wrote comes there when it is over. Then tables and figures of all seeds that are complete
    are written. An interruption ends the cells that run, without their files.

    Returns:
        the results of these seeds, and a line for each cell that failed.
    """
    left = [cell for cell in todo if not _is_done(cell, folder)]
    failed: list[str] = []
    done = len(todo) - len(left)

    def begin(cell: Cell) -> Task[None]:
        return Task(partial(_run_there, cell), folder, str(_places(cell, Path())[0]))

    def ended(cell: Cell, task: Task[None]) -> None:
        nonlocal done
        done += 1
        try:
            task.result()
        except TaskFailed as error:
            failed.append(f"{_words(cell)}: {error}")
        say(done / len(todo), f"{done} of {len(todo)}, {failed[-1] if failed else 'none failed'}")

    folder.mkdir(parents=True, exist_ok=True)
    run_tasks(left, begin, jobs, ended)
    return _write_results(todo, folder), failed


def tables(rows: Sequence[Row]) -> dict[str, list[tuple[str, ...]]]:
    """Tables that compare the paper's numbers with ours, by task."""
    return {task: table(rows, task) for task in dict.fromkeys(row["task"] for row in rows)}


def _write_results(todo: Sequence[Cell], folder: Path) -> list[Row]:
    """Put rows, tables and figures of all seeds that are complete into the folder, and return the rows."""
    from surrogym_lab.reproduce.paper_pictures import draw_all

    left = {cell.seed for cell in todo if not _is_done(cell, folder)}
    rows = [_row(cell, folder) for cell in todo if cell.seed not in left]
    (folder / "rows.json").write_text(json.dumps(rows) + "\n", encoding="utf-8")
    with (folder / "results.csv").open("w", newline="", encoding="utf-8") as file:
        csv.writer(file).writerows([("task", "arm", "seed", "what", "value"), *per_seed(rows)])
    text = "\n".join(f"{task}\n\n{markdown(lines)}" for task, lines in tables(rows).items())
    (folder / "results.md").write_text(text, encoding="utf-8")
    draw_all(rows, folder)
    return rows


def _words(cell: Cell) -> str:
    return f"{cell.task} {cell.arm} seed {cell.seed}"


def _run_there(cell: Cell, folder: Path) -> None:
    """Run a cell, in a process of the cluster."""
    _run(cell, folder, lambda *_: None)


def _run(cell: Cell, folder: Path, tell: Say) -> None:
    """Run the stages that have no result, with a server of the cell's own."""
    design, policy = _places(cell, folder)
    policy.mkdir(parents=True, exist_ok=True)
    if not (design / DATABASE).exists():
        (design / "design.json").unlink(missing_ok=True)  # its surrogate is needed
    with _server(design) as api:
        _stage(design / "design.json", lambda: _design(cell, api, tell))
        if cell.trained:
            _stage(policy / "training.json", lambda: _train(cell, api, policy, tell))
            _stage(policy / f"{cell.episodes_name}.json", lambda: _episodes(cell, api, policy, tell))


def _stage(done: Path, run: Callable[[], Row]) -> None:
    """Run a stage unless its result exists. The result is written whole or not at all."""
    if done.exists():
        return
    result, draft = run(), done.with_suffix(".part")
    draft.write_text(json.dumps(result) + "\n", encoding="utf-8")
    draft.replace(done)


def _design(cell: Cell, api: Api, tell: Say) -> Row:
    """Answer the queries of the design. Then compare some of its models with unseen real steps."""
    spec = cell.spec
    budget = api.create_surrogate(cell.name, spec).budget
    environment = make(spec.environment, spec=spec)
    try:
        answered = count(1)

        def look(query: Query, outcome: Outcome, error: str) -> None:
            del query  # its number counts those of all designs
            number = next(answered)
            tell(min(0.3, 0.3 * number / budget), f"real step {number} {outcome}{': ' if error else ''}{error}")

        Sampler(api, cell.name, environment, SamplerSettings(until_done=True), look).run()
    finally:
        environment.close()
    view = wait_for_design(api, cell.name, PATIENCE_SECONDS)
    models = api.models(cell.name)
    tell(0.3, "errors of its models")
    unseen = Unseen(spec, cell.scale.unseen)
    errors = [unseen.errors(api, cell.name, model) for model in some(models, cell.scale.versions)]
    api.report_steps(cell.name, cell.scale.unseen, note="unseen single steps", idempotency_key=f"{cell.name}-unseen")
    return {
        "commit": commit(),
        "initial": view.ledger.initial,
        "adaptive": view.ledger.adaptive,
        "phase": view.phase,
        "confidence": confidences(models),
        "errors": [{k: e[k] for k in ("samples", "reward", "state")} for e in errors],
        "response": {"real": unseen.reward.tolist(), "low": errors[0], "high": errors[-1]},
        "samples": [{"purpose": s.purpose, "coordinates": s.coordinates} for s in api.samples(cell.name)],
    }


def _train(cell: Cell, api: Api, place: Path, tell: Say) -> Row:
    def look(now: TrainProgress) -> None:
        tell(0.3 + 0.6 * now.steps / now.total_steps, f"{now.steps} of {now.total_steps} virtual steps")

    settings = TrainSettings(REFERENCE, cell.scale.steps, seed=cell.seed)
    with HttpSurrogate(api.url, cell.name, "") as port:
        result = train(port, place / "policy.zip", settings, look)
    return {
        "virtual_steps": result.virtual_steps,
        "seconds": result.seconds,
        "imagined_return": result.imagined_return,
    }


def _episodes(cell: Cell, api: Api, place: Path, tell: Say) -> Row:
    predict, spec, results = load_policy(place / "policy.zip"), cell.paper_task.evaluated, {}
    for variation in cell.variations:
        tell(0.9, f"{variation.episodes} real episodes, {variation.name}")
        results[variation.name] = run_variation(predict, spec, variation)
    steps = sum(result["steps"] for result in results.values())
    api.report_steps(cell.name, steps, note="section 5", idempotency_key=f"{cell.name}-{cell.episodes_name}")
    return results


@contextmanager
def _server(folder: Path) -> Iterator[Api]:
    """A server on the folder's database, which stops with the context."""
    ready = folder / "server.url"
    ready.unlink(missing_ok=True)
    options = ["--port", "0", "--database", str(folder / DATABASE), "--ready-file", str(ready)]
    with Children(folder) as children:
        child = children.start("server", "surrogym_server", ["serve", *options, "--log-level", "warning"])
        with Api(await_file(child, ready), token="", retries=Retries(seconds=10.0)) as api:
            yield api


def _places(cell: Cell, folder: Path) -> tuple[Path, Path]:
    """The folder of a cell's design, and the results of its policy."""
    design = folder / "cells" / cell.name
    return design, design / cell.policy_name


def _is_done(cell: Cell, folder: Path) -> bool:
    design, policy = _places(cell, folder)
    return (policy / f"{cell.episodes_name}.json" if cell.trained else design / "design.json").exists()


def _row(cell: Cell, folder: Path) -> Row:
    design, policy = _places(cell, folder)
    stages = {"design": design / "design.json"}
    if cell.trained:
        stages |= {"training": policy / "training.json", "episodes": policy / f"{cell.episodes_name}.json"}
    read = {stage: json.loads(path.read_text(encoding="utf-8")) for stage, path in stages.items()}
    return {"task": cell.task, "arm": cell.arm, "seed": cell.seed, **read}
