"""Files that an import writes: none overwrites a file that it reads, and none fails after steps were stored."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from support import reactor
from support.server import ServerProcess
from surrogym.cli import main
from surrogym_client.transport import Api
from surrogym_sampler.logs import UnusableLog, import_log
from surrogym_sampler.logs.importing import keep_rejected, read_log

NOWHERE = "http://127.0.0.1:9"  # no server: a refusal comes before a request


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with a log, a mapping and a specification."""
    log = reactor.log(runs=3, length=20).write(tmp_path / "log.csv")
    (tmp_path / "spec.json").write_text(read_log(log).spec.model_dump_json())
    (tmp_path / "map.json").write_text("{}")
    (tmp_path / "link.csv").hardlink_to(log)
    return tmp_path


def refusal(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    with pytest.raises(SystemExit) as ended:
        main(["import", *map(str, arguments)])
    assert ended.value.code not in (0, None)
    return capsys.readouterr().err


@pytest.mark.parametrize("option", ["--rejected", "--draft", "--picture"])
@pytest.mark.parametrize("name", ["log.csv", "link.csv", "map.json", "spec.json"])
def test_an_import_output_never_overwrites_an_input_file(
    folder: Path, capsys: pytest.CaptureFixture[str], option: str, name: str
):
    before = {file.name: file.read_bytes() for file in folder.iterdir()}
    inputs = (folder / "log.csv", "--map", folder / "map.json", "--spec", folder / "spec.json")
    said = refusal(capsys, *inputs, option, folder / name)
    assert f"{option}: expected another file than " in said
    assert {file.name: file.read_bytes() for file in folder.iterdir()} == before


def test_two_import_outputs_with_the_same_file_name_are_refused(folder: Path, capsys: pytest.CaptureFixture[str]):
    said = refusal(capsys, folder / "log.csv", "--draft", folder / "a.png", "--picture", folder / "a.png")
    assert "--picture: expected another file than --draft" in said
    said = refusal(capsys, folder / "log.csv", "--draft", folder / "log.rejected.csv")
    assert "--draft: expected another file than the rejected rows" in said


def test_the_rejected_rows_of_the_library_never_overwrite_the_log(folder: Path):
    with pytest.raises(UnusableLog, match="the file of rejected rows: expected another file than the log"):
        import_log(folder / "log.csv", rejected=folder / "log.csv")


@pytest.mark.parametrize(
    ("option", "name", "says"),
    [
        ("--picture", "x.jpg", "expected a name that ends in .png, .svg or .pdf, got 'x.jpg'"),
        ("--draft", "missing/x.json", "expected a file in a folder that exists"),
        ("--picture", "missing/x.png", "expected a file in a folder that exists"),
        ("--rejected", "missing/x.csv", "expected a file in a folder that exists"),
        ("--draft", "", "expected a file, got the folder"),
    ],
)
def test_an_unwritable_import_output_is_refused_before_anything_is_stored(
    folder: Path, capsys: pytest.CaptureFixture[str], option: str, name: str, says: str
):
    said = refusal(capsys, folder / "log.csv", "--register", "new", "--server", NOWHERE, option, folder / name)
    assert f"{option}: {says}" in said


def test_a_log_in_a_write_protected_folder_can_be_read(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    """Rejected rows go beside the log only where there are some."""
    monkeypatch.setattr("os.access", lambda _path, mode, **_options: mode != os.W_OK)
    with pytest.raises(SystemExit) as ended:
        main(["import", str(folder / "log.csv")])
    assert not ended.value.code
    assert "is write-protected" in refusal(capsys, folder / "log.csv", "--draft", folder / "draft.json")


FOREIGN = "line;note\n7;my own remark\n"


@pytest.fixture
def damaged(tmp_path: Path) -> Path:
    """A log with a row that can't be used."""
    return reactor.log(runs=3, length=20).at(4, "temperature", "nan").write(tmp_path / "log.csv")


def test_the_file_of_rejected_log_rows_never_replaces_an_unrelated_file(
    damaged: Path, capsys: pytest.CaptureFixture[str]
):
    """The default name was taken from the log's, so nobody had named the file that was lost."""
    other = damaged.with_name("log.rejected.csv")
    other.write_text(FOREIGN)
    said = refusal(capsys, damaged)
    assert "1 row of the log can't be used" in said
    assert str(other) in said
    assert "--rejected" in said
    assert other.read_text() == FOREIGN
    log = read_log(damaged)
    with pytest.raises(UnusableLog, match="--rejected"):
        keep_rejected(damaged, log)
    assert keep_rejected(damaged, log, other) == other, "a file that was named is replaced"
    assert keep_rejected(damaged, log) == other, "and is one of rejected rows then"


def test_an_unrelated_file_with_the_rejected_rows_name_does_not_hinder_a_valid_log(folder: Path):
    other = folder / "log.rejected.csv"
    other.write_text(FOREIGN)
    assert import_log(folder / "log.csv").rejected_file is None
    assert other.read_text() == FOREIGN


def test_a_log_without_usable_rows_beside_an_unrelated_file_reports_both_problems(damaged: Path):
    lines = damaged.read_text().splitlines()
    damaged.write_text("\n".join([lines[0], lines[5]]))
    damaged.with_name("log.rejected.csv").write_text(FOREIGN)
    with pytest.raises(UnusableLog, match=r"expected two usable steps .*--rejected"):
        import_log(damaged)
    assert damaged.with_name("log.rejected.csv").read_text() == FOREIGN


def test_a_drafted_specification_never_replaces_an_edited_one(folder: Path, capsys: pytest.CaptureFixture[str]):
    """The specification that a person had edited was lost without a word, and the log was stored."""
    drafted = folder / "drafted.json"
    for _ in range(2):  # the same draft again is no loss
        with pytest.raises(SystemExit) as ended:
            main(["import", str(folder / "log.csv"), "--draft", str(drafted)])
        assert not ended.value.code
        capsys.readouterr()
    edited = drafted.read_text().replace('"reward"', ' "reward"')
    drafted.write_text(edited)
    said = refusal(capsys, folder / "log.csv", "--draft", drafted)
    assert f"--draft: {drafted} exists, and differs from the specification that would be written" in said
    assert said.rstrip().endswith("give another name, or remove the file")
    assert drafted.read_text() == edited


def test_no_step_is_sent_if_the_draft_is_refused(server_process: ServerProcess, folder: Path):
    (folder / "drafted.json").write_text("{}")
    with pytest.raises(UnusableLog, match=r"--draft: .* exists"):
        import_log(folder / "log.csv", register="refused-draft", draft=folder / "drafted.json", url=server_process.url)
    with Api(server_process.url) as api:
        assert "refused-draft" not in [one.name for one in api.surrogates()]
