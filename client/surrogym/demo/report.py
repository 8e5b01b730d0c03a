"""Results of a demo: as JSON for programs, as a table for people."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

from surrogym.demo.judging import Judgement
from surrogym.demo.learning import REPORT, Learned
from surrogym.demo.settings import DemoSettings, fingerprint
from surrogym_client.runtime.versions import machine, versions
from surrogym_client.surrogates.waiting import IN_WORDS
from surrogym_trainer.evaluation.evaluator import Evaluation
from surrogym_trainer.policies.card import PolicyCard, read_card

# Settings of a training that differ between runs of the same kind, and don't count as its configuration.
BY_RUN = (
    "seed",
    "start_from",
    "tensorboard",
    "tensorboard_log",
    "total_steps",
    "tracker",
)


def metrics_of(
    settings: DemoSettings, learned: Learned, judgement: Judgement, seconds: dict[str, float]
) -> dict[str, Any]:
    """Return all results and settings of one run, as values that JSON can represent."""
    card, real, also, without = read_card(learned.policy), *judgement.results
    return {
        "task": settings.task,
        **settings.labels,
        "seed": settings.seed,
        "budget": settings.real_steps,
        "environment": settings.demo_task.environment,
        "real_queries": learned.real_queries,
        "description_steps": settings.description_steps,
        "evaluation_steps": judgement.steps,
        "confidence_index": learned.confidence_index,
        "fidelity": learned.fidelity,
        "phase": learned.phase,
        "virtual_steps": card.virtual_steps,
        "seconds": {phase: round(value, 3) for phase, value in seconds.items()},
        "real_return": _returns(real),
        "success_rate": real.success_rate,
        "mean_length": float(real.lengths.mean()),
        "imagined_return": card.imagined_return,
        "promise": None if card.promise is None else card.promise.model_dump(),
        "audit": None if card.audit is None else card.audit.model_dump(),
        "varied": list(real.varied),
        "trusted": card.trusted,
        "reason": card.reason,
        "returns": real.returns.tolist(),
        "lengths": real.lengths.tolist(),
        "also": _also_of(settings, also),
        "without": {**_returns(without), "actions": judgement.without.controller},
        "target": settings.demo_task.target.words,
        "reached": judgement.reached,
        "settings": {"algorithm": card.algorithm, **card.settings},
        "demo": asdict(settings),
        "specification": fingerprint(settings.asked()),
        "configuration": fingerprint({"asked": settings.asked(), "training": _training(card)}),
        "machine": machine(),
        "versions": versions(),
    }


def table(metrics: dict[str, Any], folder: Path) -> str:
    """Return the results of a run as a text table of two columns, for people."""
    returns, index = metrics["real_return"], metrics["confidence_index"]
    design = IN_WORDS.get(metrics["phase"], metrics["phase"])
    rows = [
        ("task", f"{metrics['task']} ({metrics['environment']}), seed {metrics['seed']}"),
        ("real steps", _real_steps(metrics)),
        (
            "confidence index",
            "-" if index is None else f"{index:.4f}, {design}",
        ),
        ("virtual steps", str(metrics["virtual_steps"])),
        ("seconds", _seconds(metrics["seconds"])),
        (
            f"real return, {returns['episodes']} starts",
            ", ".join(f"{key} {_number(returns[key])}" for key in ("mean", "iqm", "min", "max")),
        ),
        ("imagined return", _number(metrics["imagined_return"])),
        *_promise(metrics),
        ("success", _share(metrics["success_rate"])),
        *_also(metrics),
        _without(metrics),
        ("target", f"{metrics['target']}: {'reached' if metrics['reached'] else 'not reached'}"),
        ("evaluation", f"{metrics['evaluation_steps']} real steps, measured afterwards, nothing learned"),
        ("run folder", str(folder)),
        *([("report", str(folder / REPORT))] if (folder / REPORT).exists() else []),
    ]
    width = max(len(name) for name, _ in rows)
    return "\n".join(f"  {name.ljust(width)}  {value}" for name, value in rows)


def _returns(result: Evaluation) -> dict[str, Any]:
    summary = result.summary()
    return {key: summary[key] for key in ("mean", "iqm", "min", "max", "std", "episodes")}


def _also_of(settings: DemoSettings, also: Evaluation | None) -> dict[str, Any] | None:
    starts = settings.demo_task.also
    if also is None or starts is None:
        return None
    return {"starts": starts.words, **_returns(also), "success_rate": also.success_rate}


def _training(card: PolicyCard) -> dict[str, Any]:
    return {name: value for name, value in card.settings.items() if name not in BY_RUN}


def _also(metrics: dict[str, Any]) -> list[tuple[str, str]]:
    also = metrics["also"]
    return (
        []
        if also is None
        else [(also["starts"], f"mean {_number(also['mean'])}, success {_share(also['success_rate'])}")]
    )


def _without(metrics: dict[str, Any]) -> tuple[str, str]:
    without = metrics["without"]
    actions = "an action of zero" if without["actions"] == "zero" else "random actions"
    return "without the policy", f"mean {_number(without['mean'])}, {without['episodes']} starts, {actions}"


def _real_steps(metrics: dict[str, Any]) -> str:
    """Describe the real steps of the design, of drafting a specification, and of audits."""
    real = metrics["real_queries"]
    others = {"description": metrics["description_steps"], "audit": _audit_steps(metrics)}
    parts = [str(real["total"]), *(f"{steps} for the {name}" for name, steps in others.items() if steps)]
    return f"{' + '.join(parts)} ({real['initial']} initial, {real['adaptive']} adaptive)"


def _audit_steps(metrics: dict[str, Any]) -> int:
    audit = metrics["audit"]
    steps: int = metrics["real_queries"].get("audit", 0 if audit is None else audit["steps"])
    return steps


def _promise(metrics: dict[str, Any]) -> list[tuple[str, str]]:
    """Return the rows about the promised return; empty if the policy was learned in the original environment."""
    promise = metrics["promise"]
    if promise is None:
        return []
    low, median, high = (_number(promise[name]) for name in ("low", "median", "high"))
    varied = ", ".join(metrics["varied"])
    return [
        ("promise", f"{median}, between {low} and {high} with 90 % chance"),
        *(
            [("not comparable", f"{varied} changed within real episodes, and not in the promised ones")]
            if varied
            else []
        ),
        ("trusted", f"{'yes' if metrics['trusted'] else 'no'}: {metrics['reason']}"),
    ]


def _seconds(seconds: dict[str, float]) -> str:
    phases = [f"{seconds[phase]:.1f} {phase}" for phase in ("design", "train", "evaluate") if phase in seconds]
    return f"{', '.join(phases)}, {seconds['total']:.1f} in all"


def _share(value: float | None) -> str:
    return "-" if value is None else f"{100 * value:.0f} %"


def _number(value: float | None) -> str:
    """Format a return with one decimal, or with three significant digits if its size is below 10; "-" for None."""
    if value is None:
        return "-"
    return f"{value:.1f}" if abs(value) >= 10 else f"{value:.3g}"
