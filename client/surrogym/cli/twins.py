"""A surrogate as an FMU, for ``surrogym deploy NAME --target fmu``. The server's package writes it."""

from __future__ import annotations

from importlib.metadata import entry_points
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import typer

    from surrogym.cli.groups import Service

# the server's package registers its function that writes a surrogate as an FMU under this entry point group
ENTRY_POINTS = "surrogym.twins"
FILE = ".surrogate"  # suffix of the file of an exported surrogate


def is_surrogate(name: str) -> bool:
    """Whether a name refers to a surrogate: the name of one on a server, or a file that ends in ``.surrogate``. Other
    files, names with ``@`` and names with another ending refer to policies."""
    return name.endswith(FILE) or not (Path(name).is_file() or "@" in name or Path(name).suffix)


def write_twin(
    context: typer.Context, surrogate: str, out: Path, period: float | None, service: Service
) -> dict[str, Any]:
    """Write a surrogate as an FMU into the folder ``out``, and return a description of the FMU as JSON values.

    Args:
        context: context of the command.
        surrogate: name of a surrogate on the server, or its exported file.
        out: a new or empty folder.
        period: seconds of one step; None takes that of the specification.
        service: options of the server.

    Raises:
        CommandError: the extra ``server`` is missing, the surrogate can't be written, or the folder has other files.
    """
    from surrogym.cli.errors import CommandError
    from surrogym_client.surrogates.transfer import export_surrogate

    (entry,) = entry_points(group=ENTRY_POINTS, name="fmu")
    try:
        write = entry.load()
    except ModuleNotFoundError as error:
        raise CommandError(f"a surrogate's FMU needs {error.name}: pip install 'surrogym[server]'") from error
    name = Path(surrogate).stem
    path = out / f"{name}.fmu"
    if out.exists() and (not out.is_dir() or any(one != path for one in out.iterdir())):
        raise CommandError(f"expected a new or an empty folder, got {out} with other files: name another by --out")
    if surrogate.endswith(FILE):
        content = Path(surrogate).read_bytes()
    else:
        with service.connect(context) as api:
            content = export_surrogate(api, surrogate).to_bytes()
    made, there = not out.exists(), path.exists()
    out.mkdir(parents=True, exist_ok=True)
    try:
        written = write(content, path, period)
    except OSError:
        raise
    except Exception as error:  # errors of the server's package, whose classes the client does not import
        if made and not there:
            out.rmdir()
        raise CommandError(str(error)) from error
    return {"target": "fmu", "files": [str(written.path)], "bytes": written.bytes, "binary": written.binary}


def in_words(twin: dict[str, Any]) -> str:
    """Describe a written FMU in a sentence, from the values that ``write_twin`` returned."""
    (path,) = twin["files"]
    native = f"native code for {twin['binary']}" if twin["binary"] else "its sources alone, as no C compiler is here"
    return f"{path}: an FMU of FMI 3.0 with {native}"
