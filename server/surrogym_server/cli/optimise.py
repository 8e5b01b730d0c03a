"""``surrogym optimise``: find a policy by gradients through an exported model, without a server."""

from __future__ import annotations

import json
import time
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from surrogym_server.errors import SurrogymError
from surrogym_shared.terminal import give, on_interrupt, progress, say

if TYPE_CHECKING:
    from surrogym_server.gradients import GradientSettings, Optimised
    from surrogym_shared.spec import EnvironmentSpec


def register(app: typer.Typer) -> None:
    """Add ``optimise`` to an app of commands."""
    app.command()(optimise)


def optimise(
    spec: Annotated[Path, typer.Option(help="JSON file with the specification, from surrogym export.")],
    model: Annotated[Path, typer.Option(help="File with the model (.safetensors), from surrogym export.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="File to write the policy to.")] = Path("policy.zip"),
    seed: Annotated[int, typer.Option(min=0, help="Seed of the policy and of the starts.")] = 0,
    updates: Annotated[int | None, typer.Option(min=1, help="Number of gradient steps. [default: 200]")] = None,
    horizon: Annotated[
        int | None,
        typer.Option(
            min=1, help="Number of steps of an episode to differentiate through. [default: from the specification]"
        ),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the result as JSON on standard output.")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Show no progress and no remarks.")] = False,
) -> None:
    """Find a policy by gradients through an exported model.

    This works for continuous actions only, and needs no server. The command prints the imagined return: what the policy
    earns in the model, not in the original environment.

    Example: surrogym optimise --spec spec.json --model model.safetensors --out policy.zip
    """
    nothing = "interrupted; nothing was saved; the same command starts from the beginning"
    with on_interrupt(lambda: nothing), progress("optimise", quiet=quiet) as update:
        update(0.0, "importing torch")
        import torch

        from surrogym_server.gradients import GradientSettings, Update
        from surrogym_server.gradients import optimise as climb
        from surrogym_server.local import LocalSurrogate

        torch.set_num_threads(1)  # many small products: threads cost more than they give
        chosen = GradientSettings(seed=seed, horizon=horizon)
        settings = chosen if updates is None else GradientSettings(seed=seed, horizon=horizon, updates=updates)

        def tell(now: Update) -> None:
            imagined = "" if now.imagined_return is None else f", imagined return {now.imagined_return:.1f}"
            update(now.number / settings.updates, f"{now.number} of {settings.updates} updates{imagined}")

        started = time.perf_counter()
        try:
            surrogate = LocalSurrogate.load(spec, model)
            found = climb(surrogate, settings, tell)
            found.policy.save(out)
        except (SurrogymError, OSError, ValueError) as error:
            typer.echo(f"error: {error}", err=True)
            raise typer.Exit(1) from None
    card = _write_card(out, surrogate.spec(), settings, found, time.perf_counter() - started)
    result = {"policy": str(out), **{name: card[name] for name in card if name != "spec"}}
    env = "" if surrogate.spec().environment else " --env YOUR.MODULE:CLASS"
    words = (
        f"{out}: {found.virtual_steps} virtual steps in {card['seconds']:.1f} s, imagined return "
        f"{found.imagined_return:.1f} (in the model); next: surrogym evaluate {out}{env}"
    )
    give(result, lambda: words, as_json=as_json, quiet=quiet)
    if not found.whole:
        say(f"interrupted; the best policy so far is {out}")
        raise typer.Exit(130)


def _write_card(
    out: Path, spec: EnvironmentSpec, settings: GradientSettings, found: Optimised, seconds: float
) -> dict[str, Any]:
    """Write the policy's card beside it, and return its content."""
    card: dict[str, Any] = {
        "algorithm": "gradient",
        "spec": spec.model_dump(mode="json"),
        "seed": settings.seed,
        "virtual_steps": found.virtual_steps,
        "seconds": seconds,
        "imagined_return": found.imagined_return,
        "settings": asdict(settings),
    }
    out.with_suffix(".json").write_text(json.dumps(card, indent=2) + "\n", encoding="utf-8")
    return card
