"""Checks of the files that an import writes, before anything is read, stored or written."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

from surrogym_shared.logs.table import UnusableLog
from surrogym_shared.spec import EnvironmentSpec

PICTURES = (".png", ".svg", ".pdf")
DATA = "data"  # folder inside a Minari data set that contains its files

Files = Mapping[str, Path | None]


def rejected_file(log: Path, given: str | Path | None) -> Path:
    """Return the file for rows that can't be used: ``given``, or LOG.rejected.csv beside the log if it is None."""
    if given is not None:
        return Path(given)
    log = log if log.name else log.resolve()  # the path "." has no name, but may be the folder of a data set
    return log.with_name(f"{log.stem}.rejected.csv")


def require_outputs(outputs: Files, inputs: Files, perhaps: Files | None = None) -> None:
    """Refuse outputs that would overwrite an input or each other, or that can't be written.

    Args:
        outputs: files to write, by the words that name each in a message. A file that is None is ignored.
        inputs: files to read, by the words that name each in a message.
        perhaps: files that are written only if needed, by the words that name each in a message. Their folder may be
            write-protected.

    Raises:
        UnusableLog: an output is an input, equals another output, or can't be written to its folder.
    """
    read = {words: file for words, file in inputs.items() if file is not None}
    written: dict[str, Path] = {}
    for words, file in {**(perhaps or {}), **outputs}.items():
        if file is None:
            continue
        for other, one in (read | written).items():
            if _same(file, one):
                raise UnusableLog(
                    f"{words}: expected another file than {other}, got {file} for both: give another name"
                )
        if words in outputs:
            _require_writable(words, file)
        written[words] = file


def require_picture(words: str, file: Path) -> None:
    """Raise ``UnusableLog`` unless the name of a picture ends in .png, .svg or .pdf."""
    if file.suffix not in PICTURES:
        raise UnusableLog(f"{words}: expected a name that ends in .png, .svg or .pdf, got {file.name!r}")


def write_draft(file: Path, spec: EnvironmentSpec) -> None:
    """Write a drafted specification to a file, unless the file holds another one, which a person may have edited.

    Raises:
        UnusableLog: the file exists and holds another specification.
        OSError: the file can't be written.
    """
    text = spec.model_dump_json(indent=2) + "\n"
    there = file.read_bytes().strip() if file.is_file() else b""
    if there and there != text.strip().encode():
        raise UnusableLog(
            f"--draft: {file} exists, and differs from the specification that would be written: give another name, or "
            "remove the file"
        )
    file.write_text(text, encoding="utf-8")


def _same(output: Path, other: Path) -> bool:
    """Return whether writing to ``output`` would overwrite ``other``. A device, such as /dev/null, can't be
    overwritten."""
    if output.exists() and not output.is_file():
        return False
    if other.is_dir():
        return output.resolve().is_relative_to((other / DATA).resolve())
    if output.exists() and other.exists():
        return output.samefile(other)
    return output.resolve() == other.resolve()


def _require_writable(words: str, file: Path) -> None:
    if file.is_dir():
        raise UnusableLog(f"{words}: expected a file, got the folder {file}: add a file name")
    if not file.parent.is_dir():
        raise UnusableLog(f"{words}: expected a file in a folder that exists, got {file}: make the folder first")
    if not os.access(file if file.exists() else file.parent, os.W_OK):
        raise UnusableLog(
            f"{words}: expected a file that can be written, got {file}, which is write-protected: give another file"
        )
