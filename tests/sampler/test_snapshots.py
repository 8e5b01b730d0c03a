"""A sampler saves the states that it visits, and returns to them; a snapshot that can't be used costs nothing."""

from __future__ import annotations

import uuid

import numpy as np
import pytest

from support.rail import SPEC, Rail
from surrogym_client.original.errors import SnapshotGone
from surrogym_client.sampler import Sampler, SamplerSettings
from surrogym_client.sampler.snapshots import Bounds, SnapshotFolder, least_useful
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


def sample(api, rail, folder, told=None, **settings):
    chosen = SamplerSettings(snapshots=folder, time_limit=60.0, **settings)
    report = (lambda *seen: told.append(seen)) if told is not None else None
    return Sampler(api, rail, SavedRail(), chosen, report).run()


def test_a_design_returns_to_saved_states_after_a_restart_and_past_damage(api, rail, tmp_path):
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
    returned = [query for query in api.queries(rail) if query.snapshot is not None]
    assert returned
    assert {query.id for query, outcome, _ in told if outcome == "answered"} >= {query.id for query in returned}


def test_a_query_whose_snapshot_no_longer_loads_is_chosen_anew(api, rail, tmp_path):
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


def test_a_folder_keeps_states_for_the_next_sampler(tmp_path):
    name, dropped = SnapshotFolder(tmp_path, SAVED).add(b"state", [0.5])
    again = SnapshotFolder(tmp_path, SAVED)
    assert (again.names(), again.read(name), dropped) == ([name], ((0.5,), b"state"), [])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda file: file.unlink(), "is not in"),
        (lambda file: file.write_bytes(file.read_bytes() + b"!"), "is damaged"),
        (lambda file: file.write_bytes(b"{}"), "can't be read"),
        (lambda file: file.write_bytes(file.read_bytes().replace(b'"form": 1', b'"form": 2')), "in form 2"),
    ],
)
def test_a_snapshot_that_is_not_as_written_is_gone(tmp_path, change, message):
    folder = SnapshotFolder(tmp_path, SAVED)
    name, _ = folder.add(b"state", [0.5])
    change(tmp_path / f"{name}.snapshot")
    with pytest.raises(SnapshotGone, match=message):
        folder.read(name)


def test_a_full_folder_drops_one_of_the_nearest_and_never_the_newest(tmp_path):
    folder = SnapshotFolder(tmp_path, SAVED, Bounds(count=3))
    names = [folder.add(b"", [x])[0] for x in (-0.9, 0.0, 0.8)]
    newest, dropped = folder.add(b"", [0.05])
    assert dropped == [names[1]]
    assert set(folder.names()) == {names[0], names[2], newest}


def test_a_folder_holds_no_more_bytes_than_it_may(tmp_path):
    folder = SnapshotFolder(tmp_path, SAVED, Bounds(size=2_000))
    for x in np.linspace(-1, 1, 9):
        folder.add(bytes(400), [float(x)])
    sizes = [file.stat().st_size for file in tmp_path.iterdir()]
    assert 400 < sum(sizes) <= 2_000


def test_the_older_one_of_the_nearest_two_is_least_useful():
    assert least_useful(np.array([[0.0], [1.0], [1.1], [5.0]]), keep=3) == 1
    assert least_useful(np.array([[0.0], [1.0], [1.1], [5.0]]), keep=1) == 2
