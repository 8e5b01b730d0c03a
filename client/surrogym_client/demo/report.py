"""What a demo found out: as JSON for programs, as a table for people."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from surrogym_client.evaluate import Evaluation
from surrogym_client.policy_file import PolicyCard
from surrogym_client.versions import versions
from surrogym_shared.wire import SurrogateView


def metrics_of(
    task: str, seed: int, view: SurrogateView, card: PolicyCard, result: Evaluation, seconds: dict[str, float]
) -> dict[str, Any]:
    """Every number of one run, JSON-able."""
    ledger = view.ledger
    summary = result.summary()
    returns = {key: summary[key] for key in ("mean", "iqm", "min", "max", "std", "episodes")}
    return {
        "task": task,
        "seed": seed,
        "environment": view.environment,
        "real_queries": {
            "initial": ledger.initial,
            "adaptive": ledger.adaptive,
            "total": ledger.total,
            "unresolved": ledger.unresolved,
        },
        "evaluation_steps": ledger.evaluation,
        "confidence_index": None if view.fidelity is None else view.fidelity.confidence_index,
        "fidelity": None if view.fidelity is None else view.fidelity.model_dump(mode="json"),
        "phase": view.phase,
        "virtual_steps": card.virtual_steps,
        "seconds": {phase: round(value, 3) for phase, value in seconds.items()},
        "real_return": returns,
        "success_rate": summary["success_rate"],
        "mean_length": summary["mean_length"],
        "imagined_return": card.imagined_return,
        "returns": summary["per_episode"],
        "lengths": result.lengths.tolist(),
        "settings": {"algorithm": card.algorithm, **card.settings},
        "versions": versions(),
    }


def table(metrics: dict[str, Any], folder: Path) -> str:
    """The result for a person, two columns."""
    real, seconds, returns = metrics["real_queries"], metrics["seconds"], metrics["real_return"]
    index, success = metrics["confidence_index"], metrics["success_rate"]
    rows = [
        ("task", f"{metrics['task']} ({metrics['environment']}), seed {metrics['seed']}"),
        ("real queries", f"{real['total']}: {real['initial']} initial, {real['adaptive']} adaptive"),
        ("real steps of evaluation", str(metrics["evaluation_steps"])),
        ("confidence index", "-" if index is None else f"{index:.4f}, design {metrics['phase']}"),
        ("virtual steps", str(metrics["virtual_steps"])),
        (
            "seconds",
            f"{seconds['design']:.1f} design, {seconds['train']:.1f} train, "
            f"{seconds['evaluate']:.1f} evaluate, {seconds['total']:.1f} in all",
        ),
        (
            f"real return, {returns['episodes']} starts",
            ", ".join(f"{key} {_number(returns[key])}" for key in ("mean", "iqm", "min", "max")),
        ),
        ("imagined return", _number(metrics["imagined_return"])),
        ("success", "-" if success is None else f"{100 * success:.0f} %"),
        ("run folder", str(folder)),
    ]
    width = max(len(name) for name, _ in rows)
    return "\n".join(f"  {name.ljust(width)}  {value}" for name, value in rows)


def _number(value: float | None) -> str:
    """A return as people read it: small ones keep their digits."""
    if value is None:
        return "-"
    return f"{value:.1f}" if abs(value) >= 10 else f"{value:.3g}"
