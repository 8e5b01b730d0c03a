"""``surrogym watch``: compare real steps with the model, and withdraw a promise if the plant has changed."""

from __future__ import annotations

import sys
from dataclasses import asdict
from datetime import UTC, datetime
from functools import partial
from itertools import groupby
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from surrogym.cli.errors import CommandError
from surrogym.cli.groups import Output, Service
from surrogym.cli.options import names_of_surrogates
from surrogym_shared.terminal import on_interrupt, progress, say
from surrogym_shared.words import counted, has

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from surrogym_client.transport import Api
    from surrogym_shared.logs.checking import ReadLog
    from surrogym_shared.spec import EnvironmentSpec
    from surrogym_shared.terminal import Update
    from surrogym_shared.wire import PolicyDetail, PolicyView, SurrogateView
    from surrogym_trainer.evaluation.comparing import StepOfEpisode
    from surrogym_trainer.watching.units import OtherUnits
    from surrogym_trainer.watching.watcher import Alarm, Watcher

SHOWN = 8  # at most this number of unusable rows is printed


def command(
    context: typer.Context,
    surrogate: Annotated[str, typer.Argument(help="Name of the surrogate.", autocompletion=names_of_surrogates)],
    log: Annotated[
        Path | None,
        typer.Argument(
            help="Log of real steps: CSV, NPZ, Parquet, HDF5 or a Minari data set; - reads lines of CSV from standard "
            "input. [default: the steps that the machine posts to the server]",
            show_default=False,
        ),
    ] = None,
    mapping: Annotated[
        Path | None, typer.Option("--map", help="JSON or TOML file that says what each column of the log means.")
    ] = None,
    follow: Annotated[
        bool, typer.Option("--follow", "-f", help="Continue with steps that are added, until Ctrl-C.")
    ] = False,
    false_alarm_steps: Annotated[
        float, typer.Option(min=100, help="Average number of real steps up to a false alarm, at least.")
    ] = 10_000,
    *,
    policy: Annotated[
        str, typer.Option(help="Policy whose promise depends on the machine: a version, an alias, or latest.")
    ],
    service: Service,
    output: Output,
) -> None:
    """Find out whether the machine has changed.

    The steps come from a log, or from the machine, which posts them to the server. Each step is compared with the
    model's prediction. No model learns from it. If the machine has changed, the command says which output differs, by
    how much and where, and ends with exit status 1. The policy's promised return is not trusted from then on. If the
    first steps come in other units, it says so, and ends with exit status 2. The model should fit the machine at first:
    surrogym audit tests that.

    Example: surrogym watch pendulum log.csv --policy production --follow

    Example: surrogym watch pendulum --policy production --follow
    """
    from surrogym_trainer.watching.units import OtherUnits
    from surrogym_trainer.watching.watcher import Watcher

    name, _, which = policy.rpartition("@")
    if name not in ("", surrogate):
        raise CommandError(f"expected a policy of {surrogate!r}, got {policy!r}: name the same surrogate twice")
    with service.connect(context) as api:
        view, watched = api.surrogate(surrogate), api.policies.get(surrogate, which)
        _require_own(api, surrogate, which, watched.origin)
        version, (since, later) = watched.version, (0.0, "") if log else _since(watched)
        if view.fidelity is None:
            raise CommandError(f"{surrogate!r} has no model yet to compare the steps with: let a sampler run first")
        watcher, seen, other = Watcher(api, view, false_alarm_steps), _Seen(), dict[str, OtherUnits]()
        if later:
            say(f"compares the steps posted{later}", quiet=output.quiet)
        with (
            on_interrupt(lambda: f"interrupted; no drift in {watcher.compared} real steps"),
            progress("watch", quiet=output.quiet) as update,
        ):
            posts = partial(_posts, api, surrogate, since, other, follow=follow)
            read = posts if log is None else partial(_read, log, mapping, view.spec, follow=follow)
            while True:
                alarm, units = _found(watcher, seen, read(seen), update)
                if units is None or len(seen.streams) < 2:
                    break
                other[seen.streams[0]] = units  # a later stream may be right
                watcher, seen = Watcher(api, view, false_alarm_steps), _Seen()
        if not watcher.compared + watcher.left_out:
            raise CommandError(_words_of_none(view, log, later))
        stored = None if alarm is None else _withdrawn(watcher, version, alarm, seen.found_in)
        moved = None if alarm is None or which not in watched.aliases else _moved(api, surrogate, which, version)
    named = f"{surrogate}@{version}"
    result = {
        "policy": named,
        "model": view.model_version,
        "compared": watcher.compared,
        "left_out": watcher.left_out,
        "evidence": watcher.evidence,
        "rejected": [{"line": line, "reason": reason} for line, reason in seen.rejected.items()],
        "notes": list(seen.notes),
        "other_units": None if units is None else units.words(),
        "drift": None if alarm is None else {**asdict(alarm), "region": alarm.region and alarm.region._asdict()},
        "trusted": None if stored is None else stored.trusted,
    }
    trust = _words_of_trust(stored, named, moved)
    output.give(result, lambda: "\n".join([*_words(seen, watcher, alarm, units), *trust]))
    if alarm is not None or units is not None:
        raise typer.Exit(1 if units is None else 2)


def _require_own(api: Api, surrogate: str, which: str, origin: str | None) -> None:
    """Raise ``CommandError`` if the watched policy is a copy of one of another surrogate (``origin``), because its
    promise is that of the other model, with which the steps have to be compared."""
    from surrogym.cli.commands.policy import parsed

    if origin is not None:
        home, version = parsed(origin)
        same = which if which in api.policies.get(home, version).aliases else version
        raise CommandError(
            f"expected the surrogate on which {surrogate}@{which} was trained, got {surrogate!r}: it was trained on "
            f"{home!r}; next: surrogym watch {home} --policy {same}"
        )


def _moved(api: Api, surrogate: str, alias: str, version: int) -> str | None:
    """Return a sentence if an alias does not lead to the watched version any more, else None."""
    from surrogym_client.errors import UnknownPolicy

    try:
        now = api.policies.get(surrogate, alias).version
    except UnknownPolicy:
        return f"{surrogate}@{alias} does not exist any more"
    if now == version:
        return None
    return f"{surrogate}@{alias} leads to version {now} by now, which was not watched: watch it by the same command"


def _since(policy: PolicyDetail) -> tuple[float, str]:
    """Return when an audit or real episodes last confirmed a policy's promise, or drift was reported, in seconds since
    1970, and in words; 0 and no words if none of them did. Earlier steps would give an old drift again."""
    events = [(one.created_at, "real episodes kept the promise") for one in policy.evaluations if one.promise_kept]
    if policy.audit is not None and policy.audit.passed:
        events.append((policy.created_at, "an audit passed"))
    if policy.drifted_at is not None:
        events.append((policy.drifted_at, "drift was reported"))
    if not events:
        return 0.0, ""
    at, what = max(events)
    return at, f" since {datetime.fromtimestamp(at, UTC):%Y-%m-%d %H:%M:%S} UTC, when {what}"


def _posts(
    api: Api, surrogate: str, since: float, other: Mapping[str, OtherUnits], seen: _Seen, *, follow: bool
) -> Iterator[None]:
    """Read the steps that the machine posts after the time ``since`` into ``seen``, without those of the streams
    ``other``. Yields after each reading."""
    from surrogym_trainer.watching.streams import posted, step_of

    seen.notes = tuple(f"stream {stream!r} is left out: {units.words()}" for stream, units in other.items())
    for steps in posted(api, surrogate, since, follow=follow):
        seen.streams += [one.stream for one in steps if one.stream not in other]
        seen.streams = [*dict.fromkeys(seen.streams)]
        for stream, run in groupby((one for one in steps if one.stream not in other), attrgetter("stream")):
            seen.place, seen.steps = f"stream {stream!r}, step", [step_of(one) for one in run]
            yield


def _read(log: Path, mapping: Path | None, spec: EnvironmentSpec, seen: _Seen, *, follow: bool) -> Iterator[None]:
    """Read a log into ``seen``. Yields after each reading."""
    for read in _logs(log, mapping, spec, follow=follow):
        seen.add(read)
        yield


def _words_of_none(view: SurrogateView, log: Path | None, later: str) -> str:
    """Return the error message that there are no real steps."""
    if log is not None:
        return f"expected real steps in {log}, got none: give a log with two or more rows of an episode"
    return (
        f"expected real steps that the machine has posted to {view.name!r}{later}, got none: post them to "
        f"/v1/surrogates/{view.name}/steps, or give a log"
    )


def _logs(log: Path, mapping: Path | None, spec: EnvironmentSpec, *, follow: bool) -> Iterator[ReadLog]:
    """Yield the log once. With ``follow``, or from standard input, yield its latest rows each time it has grown."""
    from surrogym_trainer.watching.logs import chunks_of_file, chunks_of_stream, read_growing, read_once

    if str(log) == "-":
        return read_growing(chunks_of_stream(sys.stdin.buffer), "standard input", mapping, spec)
    if follow:
        return read_growing(chunks_of_file(log), str(log), mapping, spec)
    return iter([read_once(log, mapping, spec)])


class _Seen:
    """Real steps that are read repeatedly: the usable steps of the last reading, and all unusable rows so far."""

    def __init__(self) -> None:
        self.steps: list[StepOfEpisode] = []  # usable steps that the last reading of the log added
        self.rejected: dict[int, str] = {}  # for each unusable row so far, the reason, by the row's line number
        self.notes: tuple[str, ...] = ()
        self.streams: list[str] = []  # streams of the posted steps, in the order of their first steps
        self.place = "line"  # what the number of a step of the last reading counts
        self.found_in = ""  # what the number of the step that gave the alarm counts
        self._line = 0

    def add(self, read: ReadLog) -> None:
        """Add a reading of the log. Rows that earlier readings had are left out."""
        from surrogym_shared.logs.rows import impossible
        from surrogym_trainer.watching.logs import steps_after

        new = steps_after(read, self._line)
        self._line = max([self._line, *(step.number for step in new)])
        spec, faults = read.spec, {}
        for step in new:
            if reason := impossible(spec, step.coordinates) or impossible(spec, step.next_coordinates):
                faults[step.number] = reason
        self.steps = [step for step in new if step.number not in faults]
        self.rejected.update({**dict(read.rejected), **faults})
        ends = f"{has(read.steps.ends, 'row')} no next state, at the end of an episode or before a gap"
        self.notes = (*read.notes, *([ends] if read.steps.ends else []))


def _found(
    watcher: Watcher, seen: _Seen, readings: Iterator[None], update: Update
) -> tuple[Alarm | None, OtherUnits | None]:
    """Compare the steps of all readings with the model up to a drift. Return the alarm, or the other units in which the
    steps seem to come; both None without a drift."""
    alarm = None
    for _ in readings:
        if (alarm := _watched(watcher, seen.steps, update, len(seen.rejected))) is not None:
            seen.found_in = seen.found_in or seen.place
            units, certain = watcher.other_units()
            if units is None or certain:
                return (alarm, None) if units is None else (None, units)
    return alarm, None


def _watched(watcher: Watcher, steps: list[StepOfEpisode], update: Update, rejected: int) -> Alarm | None:
    """Compare steps with the model. Return the alarm at the first drift; None if there is none in these steps."""
    from surrogym_trainer.watching.watcher import BATCH

    for first in range(0, len(steps), BATCH):
        if (alarm := watcher.take(steps[first : first + BATCH])) is not None:
            return alarm
        unused = f"; {rejected} rows can't be compared" if rejected else ""
        update(None, f"{watcher.compared} real steps, no drift{unused}")
    return None


def _withdrawn(watcher: Watcher, version: int, alarm: Alarm, place: str) -> PolicyView:
    """Report a drift to the server, after which the policy's promised return is not trusted. If the report fails, print
    the drift, and raise the error."""
    from surrogym_client.errors import SurrogymClientError

    try:
        return watcher.withdraw(version, alarm)
    except SurrogymClientError:
        say(f"drift, found in {place} {alarm.line}, but not reported to the server: {alarm.words()}")
        raise


def _words_of_trust(stored: PolicyView | None, named: str, moved: str | None) -> list[str]:
    """Return sentences about the trust in a policy after a drift was reported; none without a drift."""
    if stored is None:
        return []
    trust = (
        "is still trusted: real episodes have confirmed its promise since this drift was reported"
        if stored.trusted
        else "is not trusted from now on"
    )
    return [f"{named} {trust}; next: surrogym policy show {named}", *([moved] if moved else [])]


def _words(seen: _Seen, watcher: Watcher, alarm: Alarm | None, units: OtherUnits | None) -> list[str]:
    lines = [*seen.notes]
    if seen.rejected:
        lines.append(f"{counted(len(seen.rejected), 'row')} can't be compared:")
        lines += [f"  line {line}: {reason}" for line, reason in list(seen.rejected.items())[:SHOWN]]
    if watcher.left_out:
        lines.append(f"{counted(watcher.left_out, 'step')} left out, in which a constant changed or a lag is not known")
    if units is not None:
        return [*lines, f"{units.words()}; convert the steps: the policy's trust is unchanged"]
    if alarm is None:
        return [*lines, f"no drift in {counted(watcher.compared, 'real step')}"]
    found = (
        f"drift, found in {seen.found_in} {alarm.line} after {counted(alarm.compared, 'real step')}: {alarm.words()}"
    )
    if alarm.from_the_start:
        found += (
            "; it is there from the start, so the steps may be of another machine or in other units, or the model was "
            "never right here"
        )
    return [*lines, found]
