"""Readers of logs: CSV, NPZ, Parquet, HDF5 and Minari. The content of a file, not its name, decides its format."""

from __future__ import annotations

import json
from dataclasses import replace
from math import prod
from pathlib import Path
from typing import Any, Literal
from zipfile import is_zipfile

import numpy as np
from gymnasium.spaces import Box, Discrete

from surrogym_sampler.logs.arrays import require_shapes, table_of_arrays
from surrogym_shared.archives import read_arrays
from surrogym_shared.logs.table import Cells, Table, UnusableLog
from surrogym_shared.logs.text import LONGEST_CELL, MOST_COLUMNS, decoded, require_sizes, table_of_text
from surrogym_shared.logs.writing import EVALUATED
from surrogym_shared.words import listed

MINARI_FILE = "main_data.hdf5"  # file of a Minari data set that contains its arrays
Format = Literal["csv", "npz", "parquet", "hdf5", "minari", "surrogate"]

# what a file that is damaged or forged makes a reader of another library raise
UNREADABLE = (LookupError, ValueError, AssertionError, TypeError, AttributeError, RuntimeError, OSError)
MOST_METADATA = 16 * 2**20  # largest size of the metadata of a Minari data set, in bytes
MOST_BYTES = 1024**3  # largest total size of the arrays of a log, in bytes
HDF5 = b"\x89HDF\r\n\x1a\n"
# First entry of a zip file that is not an NPZ, and what the file is.
OFFICE = {
    "[Content_Types].xml": "a workbook of Excel or another file of Microsoft Office",
    "_rels/.rels": "a workbook of Excel or another file of Microsoft Office",
    "mimetype": "a file of LibreOffice or OpenDocument",
    "modelDescription.xml": "an FMU",
    "META-INF/MANIFEST.MF": "a Java archive",
}
SURROGATE = ".surrogate"


def format_of(path: Path) -> Format:
    """Return the format of the log at a path, or ``surrogate`` if it is an exported surrogate.

    Raises:
        FileNotFoundError: neither a file nor a Minari data set has this name.
        UnusableLog: the path is a folder without a Minari data set.
    """
    if path.suffix == SURROGATE:
        return "surrogate"
    if path.is_dir():
        _require_data_set(path)
        return "minari"
    try:
        with path.open("rb") as file:
            head = file.read(9)
    except FileNotFoundError:
        if _minari_has(path):
            return "minari"
        raise
    if head[:4] == b"PAR1":
        return "parquet"
    if head[:2] == b"PK":
        return "npz"
    if head[:8] == HDF5:
        return "hdf5"
    is_header = len(head) == 9 and head[8:] == b"{" and int.from_bytes(head[:8], "little") < 2**40
    return "surrogate" if is_header else "csv"


def read(path: Path) -> Table:
    """Read the log at a path. Raises ``UnusableLog`` if it is not a log or has no rows."""
    kind = format_of(path)
    if kind == "surrogate":
        raise UnusableLog(
            f"expected a log, got a surrogate's file: run surrogym import {path} without options for logs"
        )
    readers = {"csv": read_csv, "npz": read_npz, "parquet": read_parquet, "hdf5": read_hdf5, "minari": read_minari}
    table = readers[kind](path)
    if not len(table):
        raise UnusableLog(
            f"expected a surrogate's file, or a log with a heading and rows, got neither in {path}: write a "
            "heading and rows"
        )
    return table


def read_csv(path: Path) -> Table:
    """Read a CSV file with a heading, in UTF-8 or in the encoding that its first bytes or its content show."""
    text, remarks = decoded(path.read_bytes(), str(path))
    return table_of_text(text, str(path), remarks=remarks)


def read_npz(path: Path) -> Table:
    """Read the arrays of an NPZ file. Their names, such as ``states``, ``actions`` and ``rewards``, say what they
    contain. Nothing is unpickled."""
    _require_npz(path)
    try:
        arrays = read_arrays(
            path, MOST_BYTES, lambda found: require_shapes(path, {name: one.shape for name, one in found.items()})
        )
    except UnusableLog:
        raise
    except ValueError as error:
        raise UnusableLog(f"{path}: {error}; write the file again, for example by numpy.savez") from error
    named = [str(name) for name in np.atleast_1d(arrays.pop("coordinate_names", ()))]
    evaluated = arrays.pop(EVALUATED, np.array(False))
    return replace(table_of_arrays(path, arrays, named), evaluated=evaluated.shape == () and bool(evaluated))


def _require_npz(path: Path) -> None:
    """Raise ``UnusableLog`` if a zip file is damaged, or is of another kind, such as a workbook. The name of its first
    entry shows the kind, even if the file was cut off."""
    with path.open("rb") as file:
        head = file.read(512)
    first = head[30 : 30 + int.from_bytes(head[26:28], "little")].decode("utf-8", "replace")
    name = next((words for entry, words in OFFICE.items() if first.startswith(entry)), None)
    if name is not None:
        raise UnusableLog(f"expected a log as text, NPZ, Parquet or HDF5 in {path}, got {name}: save the table as CSV")
    if not is_zipfile(path):
        raise UnusableLog(
            f"expected an NPZ file in {path}, as its first bytes show, got a damaged or incomplete zip: save it again"
        )


def read_hdf5(path: Path) -> Table:
    """Read the data sets at the top level of an HDF5 file, such as those of D4RL. Groups, such as infos and metadata,
    are ignored.

    D4RL marks the end of an episode by ``terminals``, and by ``timeouts`` if the episode was cut off. The observation
    in the row after such an end belongs to the next episode.
    """
    try:
        import h5py
    except ModuleNotFoundError as error:
        raise UnusableLog("a log in HDF5 needs the package h5py: pip install 'surrogym[logs]'") from error
    try:
        with h5py.File(path, "r") as file:
            found = {name: one for name, one in file.items() if isinstance(one, h5py.Dataset)}
            groups = {name: "it is a group" for name in file if name not in found}
            require_shapes(path, {name: one.shape for name, one in found.items()})
            if not found:
                raise UnusableLog(
                    f"expected data sets with one row per step at the top of {path}, got only the groups "
                    f"{listed(groups)}: move the data sets to the top, or save them as CSV or NPZ"
                )
            table = table_of_arrays(path, {name: _cells(one[()]) for name, one in found.items()})
    except (OSError, KeyError, ValueError, RuntimeError) as error:
        if isinstance(error, UnusableLog):
            raise
        raise UnusableLog(
            f"expected an HDF5 file in {path}, got one that can't be read: {_line(error)}; save it again, or as CSV"
        ) from error
    return replace(table, ignored={**table.ignored, **groups})


def _cells(array: Any) -> Cells:
    """Convert an HDF5 array to NumPy; bytes become text."""
    cells = np.asarray(array)
    return np.char.decode(cells.astype(np.bytes_), "utf-8", "replace") if cells.dtype.kind in "SO" else cells


def read_parquet(path: Path) -> Table:
    """Read the columns of a Parquet file; a column of lists of the same length k becomes k columns."""
    try:
        from pyarrow import ArrowException, parquet, types
    except ModuleNotFoundError as error:
        raise UnusableLog("a log in Parquet needs the package pyarrow: pip install 'surrogym[logs]'") from error
    try:
        file = parquet.ParquetFile(path)
        _require_parquet(path, file.metadata)
        kinds = {field.name: field.type for field in file.schema_arrow}
        ignored = {
            name: f"its type {kind} is not one value per step" for name, kind in kinds.items() if not _is_plain(kind)
        }
        texts = [name for name, kind in kinds.items() if types.is_string(kind) or types.is_large_string(kind)]
        columns = parquet.ParquetFile(path, read_dictionary=texts).read([name for name in kinds if name not in ignored])
        arrays = {name: _of_column(path, name, columns.column(name)) for name in columns.column_names}
    except UnusableLog:
        raise
    except (ArrowException, OSError, ValueError) as error:
        raise UnusableLog(
            f"expected a Parquet file in {path}, got one that can't be read: {_line(error)}; save it again, or as CSV"
        ) from error
    table = table_of_arrays(path, arrays)
    return replace(table, ignored={**table.ignored, **ignored})


def _require_parquet(path: Path, metadata: Any) -> None:
    """Raise ``UnusableLog`` if the metadata of a Parquet file announce too many columns, rows or bytes, before anything
    is decompressed."""
    if len(metadata.schema) > MOST_COLUMNS:
        raise UnusableLog(
            f"expected at most {MOST_COLUMNS:,} columns in {path}, got {len(metadata.schema):,}: save only those of "
            "the log"
        )
    groups = [metadata.row_group(i) for i in range(metadata.num_row_groups)]
    chunks = [group.column(i) for group in groups for i in range(group.num_columns)]
    require_sizes(path, metadata.num_rows, sum(chunk.num_values for chunk in chunks))
    if (size := sum(chunk.total_uncompressed_size for chunk in chunks)) > MOST_BYTES:
        raise UnusableLog(
            f"expected at most {MOST_BYTES:,} bytes in the columns of {path}, got {size:,}: split the log by episodes"
        )


def _is_plain(kind: Any) -> bool:
    """Return whether a Parquet type is a single value or a list of numbers."""
    from pyarrow import types

    inner = (
        kind.value_type if types.is_list(kind) or types.is_large_list(kind) or types.is_fixed_size_list(kind) else None
    )
    if inner is not None:
        return bool(types.is_floating(inner) or types.is_integer(inner) or types.is_boolean(inner))
    return not (types.is_nested(kind) or types.is_binary(kind) or types.is_large_binary(kind))


def _of_column(path: Path, name: str, column: Any) -> Cells:
    """Return a Parquet column as an array (n,), or (n, k) if its cells are lists of k numbers. Equal texts share their
    memory; a text that is too long raises ``UnusableLog``."""
    from pyarrow import compute, types

    if not types.is_dictionary(column.type):
        cells = column.to_numpy()
        return _of_objects(path, name, cells) if cells.dtype == object else cells
    parts = []
    for chunk in column.chunks:
        longest = compute.max(compute.binary_length(chunk.dictionary)).as_py() if len(chunk.dictionary) else 0
        if types.is_string(chunk.dictionary.type) and longest > LONGEST_CELL:
            raise UnusableLog(
                f"expected cells of at most {LONGEST_CELL:,} letters in the column {name!r} of {path}, got "
                f"{longest:,}: shorten or drop the column"
            )
        words = np.array([*map(str, chunk.dictionary.to_pylist()), ""], dtype=object)
        parts.append(words[chunk.indices.fill_null(len(words) - 1).to_numpy()])
    return np.concatenate([np.zeros(0, dtype=object), *parts])


def _of_objects(path: Path, name: str, cells: Cells) -> Cells:
    """Return cells as an array: lists of the same length k as (n, k), other cells as text (n,)."""
    lists = [isinstance(cell, np.ndarray) for cell in cells]
    if not any(lists):
        return np.array(["" if cell is None else str(cell) for cell in cells], dtype=object)
    shapes = {cell.shape if one else None for cell, one in zip(cells, lists, strict=True)}
    if len(shapes) > 1:
        raise UnusableLog(
            f"expected lists of the same length in the column {name} of {path}, got different lengths: write each "
            "entry to a column of its own"
        )
    return np.stack(list(cells))


def _line(error: Exception) -> str:
    """Return the first line of an error's message."""
    return next(iter(str(error).splitlines()), type(error).__name__)


def read_minari(path: Path) -> Table:
    """Read all episodes of the Minari data set with this name or in this folder. Its observations and actions must be
    vectors."""
    minari = _minari()
    _require_metadata(path)
    try:
        data = minari.MinariDataset(path / "data") if path.is_dir() else minari.load_dataset(str(path))
        observations, actions = data.observation_space, data.action_space
    except UNREADABLE as error:
        raise UnusableLog(
            f"expected a Minari data set in {path}, got one with metadata that can't be read "
            f"({type(error).__name__}: {_line(error)}): record it again"
        ) from error
    width, spaces = _width(path, observations), _declared(path, actions)
    episodes = _episodes(path, data, (width, prod(actions.shape)))
    return replace(
        table_of_arrays(path, {name: np.concatenate([e[name] for e in episodes]) for name in episodes[0]}), **spaces
    )


def _require_metadata(path: Path) -> None:
    """Raise ``UnusableLog`` if the metadata of a Minari data set are too large, or promise more episodes than rows may
    be read: Minari lists the episodes in memory when it opens a data set."""
    from minari.storage.local import get_dataset_path

    file = (path if path.is_dir() else get_dataset_path(str(path))) / "data" / "metadata.json"
    if not file.is_file():
        return
    if (size := file.stat().st_size) > MOST_METADATA:
        raise UnusableLog(
            f"expected metadata of at most {MOST_METADATA:,} bytes in {file}, got {size:,}: record the data set again"
        )
    try:
        episodes = int(json.loads(file.read_bytes())["total_episodes"])
    except UNREADABLE as error:
        raise UnusableLog(
            f"expected the metadata of a Minari data set in {file}, with its number of episodes, got others: record "
            "the data set again"
        ) from error
    require_sizes(file, episodes, episodes)


def _episodes(path: Path, data: Any, widths: tuple[int, int]) -> list[dict[str, Cells]]:
    """Return the arrays of each episode by name, after a check of their total size.

    Args:
        path: the data set, for messages.
        data: the opened data set.
        widths: number of entries of an observation and of an action.
    """
    try:
        _require_minari(path, data)
        episodes = [_of_episode(n, episode, widths) for n, episode in enumerate(data.iterate_episodes())]
    except UnusableLog:
        raise
    except UNREADABLE as error:
        raise UnusableLog(
            f"expected a Minari data set in {path}, got one with an episode that can't be read: record it again"
        ) from error
    if not episodes:
        raise UnusableLog(
            f"expected a Minari data set with episodes in {path}, got a data set without episodes: record episodes"
        )
    for number, arrays in enumerate(episodes):
        rows = {name: len(array) for name, array in arrays.items()}
        if len(set(rows.values())) > 1:
            raise UnusableLog(
                f"expected an action, a reward, an end and a next observation for each step in episode {number} of "
                f"{path}, got {rows} values: record the episode again"
            )
    return episodes


def _of_episode(number: int, episode: Any, widths: tuple[int, int]) -> dict[str, Cells]:
    seen, actions = np.asarray(episode.observations), _rows(np.asarray(episode.actions))
    width = widths[0]
    if (prod(seen.shape[1:]), prod(actions.shape[1:])) != widths:
        raise ValueError(
            f"expected observations and actions of {widths} numbers, got arrays of shapes {seen.shape}, {actions.shape}"
        )
    if any(np.asarray(one).dtype.kind not in "fiub" for one in (episode.rewards, seen, actions)):
        raise TypeError("expected numbers")
    return {
        "observations": seen[:-1].reshape(-1, width),
        "actions": actions,
        "next_observations": seen[1:].reshape(-1, width),
        "reward": np.asarray(episode.rewards),
        "terminated": np.asarray(episode.terminations),
        "truncated": np.asarray(episode.truncations),
        "episode": np.full(len(episode.rewards), number),  # not its id, which two episodes may share
    }


def _require_minari(path: Path, data: Any) -> None:
    """Raise ``UnusableLog`` if the arrays of a Minari data set are too large, before any is read. The sizes come from
    the HDF5 file, because the metadata may be wrong."""
    file = Path(data.storage.data_path) / MINARI_FILE
    if not file.exists():  # the data set is not stored as HDF5, so only its metadata tell the size
        require_sizes(path, data.total_steps, data.total_steps * (2 * prod(data.observation_space.shape) + 1))
        return
    import h5py

    sizes: list[int] = []
    with h5py.File(file, "r") as opened:
        if len(opened) != data.total_episodes:
            raise UnusableLog(
                f"expected {data.total_episodes} episodes in {file}, as its metadata say, got {len(opened)}: record "
                "them again"
            )
        opened.visititems(lambda _, one: sizes.append(one.size) if isinstance(one, h5py.Dataset) else None)
    require_sizes(path, max(sizes, default=0), sum(sizes))


def _width(path: Path, space: Any) -> int:
    """Return the number of entries of an observation. Its space must be a Box of shape (n,) or (n, 1); others raise
    ``UnusableLog``."""
    if not isinstance(space, Box) or sum(size > 1 for size in space.shape) > 1:
        raise UnusableLog(
            f"expected observations that are vectors (a Box) in {path}, got the space {space}: record vectors"
        )
    return prod(space.shape)


def _declared(path: Path, space: Any) -> dict[str, Any]:
    """Return what the action space of a data set declares: whether actions are discrete, and their finite limits by
    index."""
    if isinstance(space, Discrete) and space.start == 0:
        return {"discrete": True, "limits": {"0": (0.0, float(space.n - 1))}}
    if not isinstance(space, Box) or len(space.shape) > 1:
        raise UnusableLog(
            f"expected actions of a Box (n,) or of a Discrete from 0 in {path}, got {space}: convert the actions"
        )
    ends = zip(space.low.reshape(-1).tolist(), space.high.reshape(-1).tolist(), strict=True)
    return {"discrete": False, "limits": {str(i): pair for i, pair in enumerate(ends) if np.isfinite(pair).all()}}


def _rows(array: Cells) -> Cells:
    return array[:, None] if array.ndim == 1 else array


def _minari() -> Any:
    try:
        import minari
    except ModuleNotFoundError as error:
        raise UnusableLog("a Minari data set needs the package minari: pip install 'surrogym[logs]'") from error
    return minari


def _require_data_set(folder: Path) -> None:
    """Raise ``UnusableLog`` unless a folder contains a Minari data set, with its metadata or its HDF5 file."""
    if not any((folder / "data" / name).is_file() for name in ("main_data.hdf5", "metadata.json")):
        raise UnusableLog(
            f"expected a CSV, Parquet or NPZ file, or a Minari data set, got the folder {folder}, which has no "
            "data/main_data.hdf5 or data/metadata.json"
        )


def _minari_has(path: Path) -> bool:
    """Return whether a local Minari data set has this name. Minari is imported only for a name with a version, such as
    ``x-v0``."""
    if path.suffix or path.is_absolute() or "-v" not in path.name:
        return False
    return str(path) in _minari().list_local_datasets()
