"""``surrogym export-policy``: convert a policy for other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from surrogym.cli.groups import Output, PolicyReading
from surrogym.cli.options import working


def command(
    policy: Annotated[Path, typer.Argument(help="Policy file from surrogym train or Stable-Baselines3.")],
    out: Annotated[
        Path,
        typer.Option(
            "--out", "-o", help="File to write. Its ending chooses the format: .onnx, or .pt2 for torch.export."
        ),
    ],
    *,
    reading: PolicyReading,
    output: Output,
) -> None:
    """Convert a policy to ONNX (.onnx) or torch.export (.pt2).

    The converted policy returns the most probable action. The command checks on random observations that it gives the
    same actions as the original policy.

    Example: surrogym export-policy policy.zip --out policy.onnx
    """
    from surrogym_trainer.policies.card import read_card

    card = read_card(policy)
    stays = "interrupted; no checked file was written; the same command starts from the beginning"
    with working("export", stays, quiet=output.quiet) as update:
        update(0.0, "converting and checking")
        from surrogym_trainer.policies.export import CHECKS, export_policy

        largest = export_policy(policy, out, reading.algorithm or card.algorithm, trust=reading.trust_policy)
        update(1.0, "done")
    size = out.stat().st_size
    result = {"file": str(out), "bytes": size, "observations_checked": CHECKS, "largest_difference": largest}
    words = f"{out}: {size} bytes; the same actions on {CHECKS} random observations, to {largest:.1g}"
    output.give(result, lambda: words)
