"""What can't be used as an FMU, or does not fit one, is refused in one sentence with the way out."""

from __future__ import annotations

import zipfile
from pathlib import Path

import pytest

from support.fmus import EXAMPLES, STATES, build, changed, mapping
from surrogym_sampler.original.errors import UnknownEnvironment
from surrogym_sampler.original.fmus import archive
from surrogym_sampler.original.fmus.adapter import open_simulator

pytest.importorskip("fmpy")
pytest.importorskip("pythonfmu")


@pytest.fixture(scope="module")
def tanks(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build(EXAMPLES / "two_tanks.py", tmp_path_factory.mktemp("fmus"), *STATES)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ({"<CoSimulation": "<ModelExchange"}, "for model exchange only, .*: export it for co-simulation"),
        ({'fmiVersion="2.0"': 'fmiVersion="1.0"'}, r"can't be read|of FMI 2.0 or 3.0"),
        ({'causality="input"': 'causality="parameter" variability="fixed"'}, "got no scalar input: declare an input"),
        ({' stepSize="10.0"': ""}, r'expected the seconds of one action, as \{"fmu": "copy.fmu", "step": 0.1\}'),
        ({"</fmiModelDescription>": ""}, "modelDescription.xml of .* can't be read"),
    ],
)
def test_an_fmu_whose_model_description_is_unsupported_is_refused_with_the_reason(
    tanks: Path, tmp_path: Path, words, message: str
) -> None:
    with pytest.raises(UnknownEnvironment, match=message):
        open_simulator(f"fmu:{changed(tanks, tmp_path / 'copy.fmu', words)}")


def test_an_fmu_with_code_for_another_platform_is_refused(tanks: Path, tmp_path: Path) -> None:
    foreign = changed(tanks, tmp_path / "foreign.fmu", {}, moved="win32")
    with pytest.raises(UnknownEnvironment, match=r"expected native code for \S+ in .*, got win32, win64: export it"):
        open_simulator(f"fmu:{foreign}")
    bare = changed(tanks, tmp_path / "bare.fmu", {}, left_out="modelDescription")
    with pytest.raises(UnknownEnvironment, match=r"has no modelDescription.xml, so it is not an FMU"):
        open_simulator(f"fmu:{bare}")


def test_a_damaged_fmu_file_is_refused_with_the_fault(tanks: Path, tmp_path: Path) -> None:
    whole = tanks.read_bytes()
    for content, message in ((b"hello", "is not a zip archive"), (whole[: len(whole) // 2], "is not a zip archive")):
        (tmp_path / "broken.fmu").write_bytes(content)
        with pytest.raises(UnknownEnvironment, match=message):
            open_simulator(f"fmu:{tmp_path / 'broken.fmu'}")
    flipped = bytearray(whole)
    flipped[len(whole) // 2] ^= 0xFF
    (tmp_path / "broken.fmu").write_bytes(flipped)
    with pytest.raises(UnknownEnvironment, match="is damaged: copy or export"):
        open_simulator(f"fmu:{tmp_path / 'broken.fmu'}")
    with pytest.raises(UnknownEnvironment, match="which does not exist"):
        open_simulator(f"fmu:{tmp_path / 'none.fmu'}")


@pytest.mark.parametrize(
    ("choices", "message"),
    [
        ({"start": {"flow": "much"}}, "expected a finite number for 'flow'"),
        ({"start": {"depth": 1.0}}, "has no scalar variable 'depth': expected one of pump, upper, lower, flow"),
        ({"actions": {"pump": [1, 0]}}, r"expected low < high, got \[1, 0\]"),
        ({"actions": ["flow"]}, "of the continuous inputs of .*pump.*, got flow"),
        ({"coordinates": []}, "expected continuous variables of .*, got none"),
        ({"steps": 1.0}, "expected the key fmu, and optionally step, actions, coordinates and start"),
        ({"actions": ["pump", "pump"]}, "actions: expected each variable once, got 'pump' twice"),
        ({"coordinates": ["lower", "lower"]}, "coordinates: expected each variable once, got 'lower' twice"),
        ({"step": -1.0}, "step: expected a number greater than 0"),
    ],
)
def test_fmu_options_that_do_not_fit_the_file_are_refused(tanks: Path, tmp_path: Path, choices, message: str) -> None:
    with pytest.raises(UnknownEnvironment, match=message):
        open_simulator(mapping(tmp_path, fmu=str(tanks), **choices))


def test_files_that_are_no_fmu_are_refused_without_python_terms(tmp_path: Path) -> None:
    (tmp_path / "list.json").write_text("[1]")
    with pytest.raises(UnknownEnvironment, match=r"list.json: not a JSON object; expected the key fmu"):
        open_simulator(f"fmu:{tmp_path / 'list.json'}")
    with zipfile.ZipFile(tmp_path / "bare.fmu", "w") as bare:
        bare.writestr("modelDescription.xml", "<fmiModelDescription/>")
    with pytest.raises(UnknownEnvironment, match=r"can't be read \(it lacks a part\): export the FMU anew"):
        open_simulator(f"fmu:{tmp_path / 'bare.fmu'}")


@pytest.mark.parametrize("name", ["resources/zeros.bin", "modelDescription.xml"])
def test_a_zip_bomb_as_fmu_is_refused_before_it_is_unpacked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    monkeypatch.setattr(archive, "MOST_BYTES", 1_000_000)
    monkeypatch.setattr(archive, "MOST_XML_BYTES", 1_000_000)
    with zipfile.ZipFile(tmp_path / "bomb.fmu", "w", zipfile.ZIP_DEFLATED) as bomb:
        bomb.writestr(name, bytes(2_000_000))
    monkeypatch.setattr(zipfile.ZipFile, "open", lambda *_: pytest.fail("it was unpacked"))
    with pytest.raises(UnknownEnvironment, match=r"expected an FMU of at most 1,000,000 bytes .* with 2,000,000"):
        archive.read_archive(tmp_path / "bomb.fmu")
