"""A sampler saves the states that it visits, and returns to them; a snapshot that can't be used costs nothing."""

from __future__ import annotations

import multiprocessing
import os
import uuid

import numpy as np
import pytest

from support.rail import SPEC, Rail
from support.saving import fill
from surrogym_sampler.original.errors import (
    EnvironmentDied,
    SnapshotGone,
    SnapshotNotKept,
    StepTimedOut,
    UnusableFolder,
)
from surrogym_sampler.original.rollouts import answering
from surrogym_sampler.queries import Sampler, SamplerSettings
from surrogym_sampler.queries.returning import Returning
from surrogym_sampler.queries.snapshots import Bounds, SnapshotFolder, least_useful
from surrogym_shared.spec import Design

SAVED = SPEC.model_copy(update={"snapshots": True, "design": Design(initial=6, budget=16, target=0.9999)})


class SavedRail(Rail):
    """The rail, with snapshots."""

    def spec(self):
        return SAVED

    def save(self):
        return repr(float(self.x)).encode()

    def restore(self, snapshot):
        self.x = float(snapshot)
        return np.array([self.x, self.x])


@pytest.fixture
def rail(api):
    name = f"rail-{uuid.uuid4().hex[:8]}"
    api.create_surrogate(name, SAVED)
    yield name
    api.delete_surrogate(name)


class GivesNoBytes(SavedRail):
    def save(self):
        return "text"


class RaisesInSave(SavedRail):
    def save(self):
        raise RuntimeError("no licence")


class SavesMuch(SavedRail):
    def save(self):
        return bytes(5_000)


class HangsInSave(SavedRail):
    def save(self):
        raise StepTimedOut("save took longer than 30 s and was killed")


class ReturnsElsewhere(SavedRail):
    def restore(self, snapshot):
        return super().restore(repr(float(snapshot) + 0.3).encode())


class ReturnsNowhere(SavedRail):
    def restore(self, snapshot):
        return np.array([np.nan, np.nan])


def sample(api, rail, folder, told=None, environment=SavedRail, **settings):
    chosen = SamplerSettings(snapshots=folder, time_limit=60.0, **settings)
    report = (lambda *seen: told.append(seen)) if told is not None else None
    return Sampler(api, rail, environment(), chosen, report).run()


def test_a_restarted_sampler_uses_its_intact_snapshots_and_reports_lost_ones(api, rail, tmp_path):
    """The first sampler answers the initial queries. Then one of its snapshots is damaged and one is lost."""
    told: list = []
    sample(api, rail, tmp_path, once=True)
    known = {one.name: one.coordinates for one in api.snapshots(rail)}
    files = sorted((tmp_path / rail).glob("*.snapshot"))
    assert {file.stem for file in files} == set(known)
    assert len(known) >= 4
    files[0].write_bytes(files[0].read_bytes()[:-1] + b"?")
    files[1].unlink()
    report = sample(api, rail, tmp_path, told, until_done=True)
    view, left = api.surrogate(rail), {one.name for one in api.snapshots(rail)}
    assert report.failed == 0
    assert view.phase in ("ready", "over_budget")
    assert view.ledger.total == len(list(api.samples(rail))) <= 16
    assert (view.ledger.unresolved, view.queries.set_aside) == (0, 0)
    assert files[1].stem not in left, "the server learned that it is gone"
    assert f"2 of {len(known)} snapshots that the server knew are not in this sampler's folder" in told[0][2]
    returned = [query for query in api.queries(rail) if query.snapshot is not None]
    assert returned
    assert {query.id for query, outcome, _ in told if outcome == "answered"} >= {query.id for query in returned}


def test_a_query_whose_snapshot_cannot_be_loaded_is_replaced(api, rail, tmp_path):
    class OtherVersion(SavedRail):
        def restore(self, snapshot):
            raise ValueError("made by another version")

    told: list = []
    settings = SamplerSettings(snapshots=tmp_path, time_limit=60.0, until_done=True)
    Sampler(api, rail, OtherVersion(), settings, lambda *seen: told.append(seen)).run()
    errors = [error for _, outcome, error in told if outcome == "impossible"]
    assert errors
    assert all("can't be restored: ValueError: made by another version" in error for error in errors)
    view = api.surrogate(rail)
    assert view.phase in ("ready", "over_budget")
    assert view.ledger.total >= 9
    assert (view.ledger.unresolved, view.queries.set_aside, view.queries.pending) == (0, 0, 0)


@pytest.mark.parametrize(
    "fault",
    [
        EnvironmentDied("the program ended with exit code 9 during restore"),
        StepTimedOut("restore took longer than 30 s and was killed"),
    ],
)
def test_a_snapshot_at_which_the_environment_dies_or_hangs_is_dropped(tmp_path, fault):
    class Dies(SavedRail):
        asked = 0

        def restore(self, snapshot):
            self.asked += 1
            if self.asked > 1 and snapshot == b"1.0":
                return super().restore(snapshot)
            raise fault

    for state, gone in ((b"0.5", True), (b"1.0", False)):
        folder = SnapshotFolder(tmp_path / str(gone), SAVED, Bounds(10, 10**6))
        returning = Returning(answering(Dies()), SAVED, folder)
        name, _ = folder.add(state, [0.0])
        if gone:
            with pytest.raises(SnapshotGone, match=f"can't be restored: {fault}, twice"):
                returning.begin(name)
        else:
            returning.begin(name)
        assert (returning.gone, folder.names()) == (([name], []) if gone else ([], [name]))


def test_no_snapshot_is_dropped_if_the_environment_itself_is_broken(tmp_path):
    class Broken(SavedRail):
        def restore(self, snapshot):
            raise EnvironmentDied("the program could not be started anew: no licence")

        def reset(self, *, seed=None):
            raise EnvironmentDied("the program could not be started anew: no licence")

    folder = SnapshotFolder(tmp_path, SAVED, Bounds(10, 10**6))
    returning = Returning(answering(Broken()), SAVED, folder)
    name, _ = folder.add(b"0.5", [0.0])
    with pytest.raises(EnvironmentDied):
        returning.begin(name)
    assert (returning.gone, list(folder.names())) == ([], [name])


def test_a_snapshot_folder_keeps_states_for_the_next_sampler(tmp_path):
    name, dropped = SnapshotFolder(tmp_path, SAVED).add(b"state", [0.5])
    again = SnapshotFolder(tmp_path, SAVED)
    assert (again.names(), again.read(name), dropped) == ([name], ((0.5,), b"state"), [])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda file: file.unlink(), "is not in"),
        (lambda file: file.write_bytes(file.read_bytes() + b"!"), "is damaged"),
        (lambda file: file.write_bytes(b"{}"), "can't be read"),
        (lambda file: file.write_bytes(file.read_bytes().replace(b'"form": 1', b'"form": 2')), "in file version 2"),
    ],
)
def test_a_modified_snapshot_file_is_treated_as_lost(tmp_path, change, message):
    folder = SnapshotFolder(tmp_path, SAVED)
    name, _ = folder.add(b"state", [0.5])
    change(tmp_path / f"{name}.snapshot")
    with pytest.raises(SnapshotGone, match=message):
        folder.read(name)


def test_a_full_snapshot_folder_drops_one_of_the_nearest_states_but_not_the_newest(tmp_path):
    folder = SnapshotFolder(tmp_path, SAVED, Bounds(count=3))
    names = [folder.add(b"", [x])[0] for x in (-0.9, 0.0, 0.8)]
    newest, dropped = folder.add(b"", [0.05])
    assert dropped == [names[1]]
    assert set(folder.names()) == {names[0], names[2], newest}


def test_a_snapshot_folder_never_exceeds_its_size_limit(tmp_path):
    folder = SnapshotFolder(tmp_path, SAVED, Bounds(size=2_000))
    for x in np.linspace(-1, 1, 9):
        folder.add(bytes(400), [float(x)])
    sizes = [file.stat().st_size for file in tmp_path.iterdir()]
    assert 400 < sum(sizes) <= 2_000


def test_in_a_full_snapshot_folder_the_older_of_the_two_nearest_states_is_dropped():
    assert least_useful(np.array([[0.0], [1.0], [1.1], [5.0]]), keep=3) == 1
    assert least_useful(np.array([[0.0], [1.0], [1.1], [5.0]]), keep=1) == 2


@pytest.mark.parametrize(
    ("environment", "sentence"),
    [
        (GivesNoBytes, "a state is not kept, so no query will begin there: expected save to return bytes, got a str"),
        (RaisesInSave, "a state is not kept, so no query will begin there: RuntimeError: no licence"),
        (SavesMuch, "expected a snapshot of at most 4000 bytes, which all snapshots together"),
        (ReturnsElsewhere, "restore leads to another state than was saved"),
    ],
)
def test_a_snapshot_problem_that_costs_no_real_step_is_reported_once(api, rail, tmp_path, environment, sentence):
    told: list = []
    report = sample(api, rail, tmp_path, told, environment, bounds=Bounds(size=4_000), until_done=True)
    errors = [error for _, outcome, error in told if outcome == "answered" and error]
    assert len(errors) == 1
    assert sentence in errors[0]
    view = api.surrogate(rail)
    assert report.steps == view.ledger.total == len(list(api.samples(rail)))
    assert (report.failed, view.ledger.unresolved, view.queries.set_aside) == (0, 0, 0)
    assert view.phase in ("ready", "over_budget")


def test_a_hanging_snapshot_save_ends_its_rollout_and_stops_further_saving(api, rail, tmp_path):
    """No step may follow in the same query: it would begin elsewhere, and the server would refuse the whole answer."""
    told: list = []
    report = sample(api, rail, tmp_path, told, HangsInSave, until_done=True)
    errors = [error for _, _, error in told if error]
    hung = "save took longer than 30 s and was killed"
    assert errors == [hung, f"{hung}; this sampler saves no state any more, because save hung or died too often"]
    view = api.surrogate(rail)
    assert (report.steps, view.ledger.unresolved) == (view.ledger.total, 0)


def test_restoring_a_snapshot_to_nan_coordinates_costs_no_real_step(api, rail, tmp_path):
    told: list = []
    sample(api, rail, tmp_path, told, ReturnsNowhere, until_done=True)
    errors = [error for _, outcome, error in told if outcome == "impossible"]
    assert errors
    assert all("can't be restored: expected coordinates (x), got array([nan]); " in error for error in errors)
    assert api.surrogate(rail).ledger.unresolved == 0


def test_samplers_can_share_a_full_snapshot_folder(tmp_path):
    """Each drops the newest files of the other at any moment."""
    spawn = multiprocessing.get_context("spawn")
    both = [spawn.Process(target=fill, args=(tmp_path, SAVED, seed)) for seed in range(2)]
    for process in both:
        process.start()
    for process in both:
        process.join()
    assert [process.exitcode for process in both] == [0, 0]
    assert {file.suffix for file in tmp_path.iterdir()} == {".snapshot"}


def test_a_snapshot_dropped_by_another_sampler_before_its_sample_was_sent_is_reported(tmp_path):
    folder = SnapshotFolder(tmp_path, SAVED)
    returning = Returning(SavedRail(), SAVED, folder)
    names = [folder.add(b"", [x])[0] for x in (0.1, 0.2)]
    SnapshotFolder(tmp_path, SAVED).drop(names[0])
    returning.handed_in(names)
    assert returning.gone == [names[0]]


def test_snapshots_unknown_to_the_server_are_dropped_first(tmp_path):
    """A killed sampler did not send its sample, or the surrogate was deleted and made again."""
    folder = SnapshotFolder(tmp_path, SAVED, Bounds(count=3))
    names = [folder.add(b"", [x])[0] for x in (0.0, 0.01, 0.9)]
    folder.drop_first([names[2]])
    assert folder.add(b"", [-0.9])[1] == [names[2]]


def test_unfinished_snapshot_files_of_a_killed_sampler_are_removed(tmp_path):
    old, new = (tmp_path / f"{name}.part" for name in ("old", "new"))
    for path in (old, new):
        path.write_bytes(b"{")
    os.utime(old, (0, 0))
    SnapshotFolder(tmp_path, SAVED)
    assert [path.exists() for path in (old, new)] == [False, True]


def test_a_snapshot_that_cannot_be_written_leaves_the_others_unchanged(tmp_path):
    resource = pytest.importorskip("resource")
    folder = SnapshotFolder(tmp_path, SAVED, Bounds(size=1_000_000))
    name, _ = folder.add(b"state", [0.5])
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, before[1]))
    try:
        with pytest.raises(SnapshotNotKept, match="File too large"):
            folder.add(bytes(100_000), [0.1])
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    with pytest.raises(SnapshotNotKept, match="at most 1000000 bytes"):
        folder.add(bytes(1_000_000), [0.1])
    assert [file.name for file in tmp_path.iterdir()] == [f"{name}.snapshot"]


def test_a_snapshot_folder_that_is_a_file_is_refused(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(
        UnusableFolder, match=r"expected a folder for snapshots that can be written to, got .*/file/rail"
    ):
        SnapshotFolder(tmp_path / "file" / "rail", SAVED)


def test_the_server_lists_no_snapshot_whose_file_was_dropped_from_a_full_folder(api, rail, tmp_path):
    """Snapshots are dropped while the samples of others, and their own, are on the way to the server."""
    report = sample(api, rail, tmp_path, bounds=Bounds(count=2), until_done=True)
    files = {file.stem for file in (tmp_path / rail).iterdir()}
    assert len(files) == 2
    assert {one.name for one in api.snapshots(rail)} <= files
    assert (report.failed, api.surrogate(rail).ledger.unresolved) == (0, 0)
