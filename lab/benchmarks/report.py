"""What was to be reached and what was, as one table in Markdown, from the JSON files of the parts that were run.

``report.py --out FOLDER`` prints it again.
"""

from __future__ import annotations

import argparse
import json
import statistics
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from common import OUT

Line = tuple[str, str, str, bool | None]  # what, target, reached, whether; None where there is no target
FIT_SECONDS = {"500": 5, "2000": 20, "5000": 30}
PHASES = ("start", "design", "train", "checks", "evaluate", "total")  # of a demo
PEERS = ("openenv", "rlmesh", "dm_env_rpc")


def table(out: Path) -> str:
    """The lines of every part whose file is in the folder."""
    lines = ["| what | target | reached | |", "| --- | --- | --- | --- |"]
    for part, read in PARTS.items():
        if not (file := out / f"{part}.json").exists():
            continue
        found = json.loads(file.read_text())
        for what, target, reached, held in read(found):
            said = "" if held is None else "yes" if held else "**no**"
            lines.append(f"| {what} | {target} | {reached} | {said} |")
    return "\n".join([*lines, "", *_machines(out)])


def step(found: dict[str, Any]) -> Iterator[Line]:
    for lanes, measured in found["round_trip_us"].items():
        trip, echo = measured["trivial, stream"], measured["echo, WebSocket library"]
        reached = f"{trip['to library']:.2f} x ({trip['p50']:.0f} beside {echo['p50']:.0f} µs)"
        yield f"stream beside uvicorn's echo, N = {lanes}", "1.5 x", reached, trip["to library"] <= 1.5
    for lanes, measured in found["round_trip_us"].items():
        trip, echo = measured["trivial, stream"], measured["echo, WebSocket"]
        reached = f"{trip['ratio']:.2f} x ({trip['p50']:.0f} beside {echo['p50']:.0f} µs)"
        yield f"the same, the echo through our own client, N = {lanes}", "", reached, None
    for lanes, measured in found["round_trip_us"].items():
        trip, echo = measured["trivial, binary"], measured["echo, HTTP"]
        reached = f"{trip['ratio']:.2f} x ({trip['p50']:.0f} beside {echo['p50']:.0f} µs)"
        yield f"binary HTTP beside Starlette's echo, N = {lanes}", "1.3 x", reached, trip["ratio"] <= 1.3
    for lanes, measured in found["step_us"].items():
        share, rate = 1 / measured["stream"]["ratio"], int(lanes) / measured["stream"]["p50"]
        target, held = ("85 %", share >= 0.85) if lanes == "1024" else ("", None)
        reached = f"{share:.0%} of in process ({rate:.2f} million env-steps/s)"
        yield f"Pendulum over the stream, N = {lanes}", target, reached, held


def peers(found: dict[str, Any]) -> Iterator[Line]:
    us = found["us"]
    others = {name: us[name]["p50"] for name in PEERS if name in us}
    shown = ", ".join(f"{name} {p50:,.0f}" for name, p50 in others.items())
    ours = us["Surrogym, stream"]["p50"]
    fastest = len(others) == len(PEERS) and ours < min(others.values())
    yield "N = 1, p50, beside other systems", "fastest", f"{ours:.0f} µs beside {shown}", fastest


def train(found: dict[str, Any]) -> Iterator[Line]:
    low, high = found["quartiles"]
    reached = f"{found['ratio']:.3f} x (half of {len(found['pairs']['stream'])} pairs {low:.3f} to {high:.3f})"
    yield "PPO, 16 lanes, remote beside in process", "1.10 x", reached, found["ratio"] <= 1.1


def rollout(found: dict[str, Any]) -> Iterator[Line]:
    for lanes, measured in found["lanes"].items():
        share = measured["share, by rollout"]
        reached = f"{share:.0%}; by step {measured['share, by step']:.0%}"
        reached += f", given actions {measured['share, given actions']:.0%}"
        yield f"a policy's rollout over the stream beside in process, N = {lanes}", "85 %", reached, share >= 0.85
    whole = found["trainings"]
    reached = (
        f"{whole['ratio']:.3f} x ({len(whole['pairs'])} pairs, {whole['pairs'][0]:.3f} to {whole['pairs'][-1]:.3f})"
    )
    yield "FASTPPO, remote beside in process", "1.05 x", reached, whole["ratio"] <= 1.05


def search(found: dict[str, Any]) -> Iterator[Line]:
    whole, one = found["trainings"], found["updates"]
    runs = {name: [run["imagined"] for run in each] for name, each in whole["runs"].items()}
    imagined = ", ".join(f"{name} {' '.join(f'{value:.1f}' for value in each)}" for name, each in runs.items())
    reached = f"{whole['ppo / fastppo']:.1f} x ({one['ppo / fastppo']:.1f} x an update); imagined returns {imagined}"
    yield (
        f"{whole['steps']:,} virtual steps of Pendulum, PPO beside FASTPPO",
        "3 x",
        reached,
        whole["ppo / fastppo"] >= 3,
    )


def phases(found: dict[str, Any]) -> Iterator[Line]:
    """Totals are compared; a line has the phases of both sides."""
    for task in dict.fromkeys(run["task"] for run in found["runs"]):
        taken = {
            side: [run["seconds"] for run in found["runs"] if (run["task"], run["side"]) == (task, side)]
            for side in ("before", "after")
        }
        middle = {
            side: {phase: statistics.median(run[phase] for run in runs) for phase in PHASES}
            for side, runs in taken.items()
        }
        shown = "; ".join(f"{phase} {middle['before'][phase]:.1f}, {middle['after'][phase]:.1f}" for phase in PHASES)
        share = middle["after"]["total"] / middle["before"]["total"]
        yield f"demo {task}, seconds before and after", "a third", f"{share:.2f}: {shown}", share <= 1 / 3


def start(found: dict[str, Any]) -> Iterator[Line]:
    for name, taken in found["subjects"].items():
        low, high, goal = min(taken["all"]), max(taken["all"]), taken["goal"]
        yield (
            f"start: {name}",
            f"{goal:g} s",
            f"{taken['seconds']:.2f} s ({low:.2f} to {high:.2f})",
            taken["seconds"] < goal,
        )


def fit(found: dict[str, Any]) -> Iterator[Line]:
    for samples, taken in found["sizes"].items():
        reached = f"{taken['seconds']:.1f} s ({taken['processor']:.1f} s of processor time)"
        bound = FIT_SECONDS.get(samples)
        target, held = ("", None) if bound is None else (f"{bound} s on free cores", taken["seconds"] <= bound)
        yield f"fit of four outputs, n = {samples}", target, reached, held
    for lanes, measured in found["lanes"].items():
        rest, busy = measured["rest"], measured["samples and fits"]
        later = (busy["p99"] - rest["p99"]) / 1e3
        reached = (
            f"p50 {rest['p50']:.0f} to {busy['p50']:.0f} µs, p99 {rest['p99']:.0f} to {busy['p99']:.0f} µs, longest "
            f"{rest['longest'] / 1e3:.1f} to {busy['longest'] / 1e3:.1f} ms ({measured['fits']} fits)"
        )
        held = measured["fits"] > 0 and later < 5
        yield f"steps while samples come and fits run, N = {lanes}", "p99 later by < 5 ms", reached, held


def predict(found: dict[str, Any]) -> Iterator[Line]:
    predictions, particles, _, growth, threads = (rows for rows in found.values() if isinstance(rows, list))
    for row in predictions:
        sklearn, gpytorch, bare = (row[name] / row["Surrogym"] for name in ("scikit-learn", "GPyTorch", "products"))
        best = min(gpytorch, row["GPyTorch, fast_pred_var"] / row["Surrogym"])
        target = {1: "faster", 1_024: "faster, 3 x products", 8_192: "faster, 10 x GPyTorch, 3 x products"}[
            row["batch"]
        ]
        held = min(sklearn, best) > 1 and (row["batch"] == 1 or 1 / bare <= 3) and (row["batch"] < 8_192 or best >= 10)
        reached = (
            f"{row['Surrogym']:.3f} ms; scikit-learn {sklearn:.1f} x, GPyTorch {best:.1f} x as long; "
            f"{1 / bare:.1f} x the products"
        )
        yield f"mean and variance, n = 125, 4 outputs, batch {row['batch']:,}", target, reached, held
    row = next(row for row in particles if row["lanes x particles"] == "64 x 1000")
    share = row["AUR-P"] / row["products"]
    reached = f"{row['steps a second']:.1f} steps/s, {share:.1f} x the products"
    yield "AUR-P, 64 lanes x 1,000 particles, n = 50", "3 x products", reached, share <= 3
    for row in threads:
        yield f"two threads, {row['what']}", "", f"{row['1 over 2']:.2f} x as fast as one", None
    largest = growth[-1]
    reached = f"{largest['extend']:.2f} ms, a factorisation anew {largest['factorise']:.1f} ms"
    yield f"one more sample at n = {largest['n']:,}", "", reached, None


def evidence(found: dict[str, Any]) -> Iterator[Line]:
    for n in dict.fromkeys(row["n"] for row in found["fits"]):
        ours, *others = (row for row in found["fits"] if row["n"] == n)
        above = max(row["at most above ours"] for row in others)
        beside = ", ".join(f"{row['by']} {row['a fit'] / ours['a fit']:.1f} x" for row in others)
        reached = (
            f"{ours['a fit']:.2f} ms; {beside} as long; theirs at most {max(above, 0.0):.0e} above our log evidence"
        )
        held = ours["a fit"] < min(row["a fit"] for row in others) and above < 1e-3
        yield f"fit of one output, 6 inputs, n = {n}", "faster, no worse", reached, held


def growth(found: dict[str, Any]) -> Iterator[Line]:
    most = {int(count): each for count, each in found["sessions"].items()}
    reached = "; ".join(f"{c}: {f['requests/s']:,.0f}/s, p99 {f['p99 us'] / 1e3:.1f} ms" for c, f in most.items())
    yield "concurrent sessions of 16 lanes", "", reached, None


def lists(found: dict[str, Any]) -> Iterator[Line]:
    for count, measured in found["surrogates"].items():
        most = 50 * int(count) / 1_000
        for path in ("/metrics", "/v1/surrogates"):
            ms, processor = measured[path]["ms"], measured[path]["processor ms"]
            yield (
                f"{path}, {int(count):,} surrogates",
                f"{most:.0f} ms",
                f"{ms:.0f} ms ({processor:.0f} of the processor)",
                ms <= most,
            )


def attacks(found: dict[str, Any]) -> Iterator[Line]:
    for name, measured in found["attacks"].items():
        p99, grown = measured["p99 ms"], measured["MiB after"] - measured["MiB before"]
        attack = name != "ordinary requests"
        reached = f"p99 {p99:.0f} ms, worst {measured['worst ms']:.0f} ms, memory {grown:+.1f} MiB"
        yield f"/healthz under: {name}", "50 ms" if attack else "", reached, p99 < 50 if attack else None


def memory(found: dict[str, Any]) -> Iterator[Line]:
    mib = [m for _, m in found["readings"]]
    reached = f"{min(mib):.1f} to {max(mib):.1f} MiB, last quarter {found['growth']:+.1%} of the first"
    yield "resident memory, 64 sessions of 256 lanes", "flat (3 %)", reached, found["growth"] <= 0.03


PARTS = {
    "step": step,
    "peers": peers,
    "train": train,
    "rollout": rollout,
    "search": search,
    "start": start,
    "phases": phases,
    "fit": fit,
    "predict": predict,
    "evidence": evidence,
    "growth": growth,
    "lists": lists,
    "attacks": attacks,
    "memory": memory,
}


def _machines(out: Path) -> list[str]:
    """When each part was run, and how loaded the machine was at its end."""
    found = {part: json.loads((out / f"{part}.json").read_text()) for part in PARTS if (out / f"{part}.json").exists()}
    if not found:
        return ["nothing was run yet"]
    one = next(iter(found.values()))["machine"]
    loads = ", ".join(
        f"{part} {each['machine']['time']} load {each['machine']['load'][0]}" for part, each in found.items()
    )
    named = f"{one['cores']} cores of {one['processor']}, Python {one['python']}, torch {one['torch']}"
    return [f"{named}. Ran: {loads}."]


if __name__ == "__main__":
    made = argparse.ArgumentParser(description=__doc__)
    made.add_argument("--out", type=Path, default=OUT)
    print(table(made.parse_args().out))
