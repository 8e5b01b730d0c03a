"""Errors of a command as one sentence for a person, without a traceback."""

from __future__ import annotations

import errno

from surrogym_client.runtime.versions import missing

# numbers of errors that writing to an open file raises, such as a full disk; they do not name the file
FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


class CommandError(Exception):
    """A command can't do its work. ``str(error)`` is the message for the user."""


def sentence(error: Exception) -> str | None:
    """Return the message for an error that a user can act on; None for a defect of the program."""
    from pydantic import ValidationError

    from surrogym_client.environments.pictures import NotRenderable
    from surrogym_client.errors import SurrogymClientError
    from surrogym_client.runtime.ray_cluster import NoCluster
    from surrogym_sampler.original.errors import OriginalError
    from surrogym_shared.c_compiler import CannotCompile
    from surrogym_shared.logs.table import UnusableLog
    from surrogym_shared.surrogate_file import NotASurrogateFile

    match error:
        case SurrogymClientError():
            return f"{error}{f'; {error.way_out}' if error.way_out else ''}"
        case CommandError() | OriginalError() | NotRenderable() | NotASurrogateFile() | UnusableLog() | NoCluster():
            return str(error)
        case CannotCompile():
            return str(error)
        case ModuleNotFoundError(name=str(name)):
            return missing(name.partition(".")[0])
        case ValidationError():
            return invalid(error)
        case OSError(filename=str(path), strerror=str(reason)):
            return f"{path}: {reason}"
        case OSError(errno=number, strerror=str(reason)) if number in FULL:
            return f"a file can't be written: {reason}"
        case _:
            return None


def notes_of(error: Exception) -> list[str]:
    """Return the notes of an error, such as what was saved, without the way out, which ``sentence`` has."""
    return [note for note in getattr(error, "__notes__", ()) if not note.startswith("What to do: ")]


def invalid(error: Exception) -> str:
    """Describe the first fault of pydantic's validation error, with the path of the wrong entry."""
    from pydantic import ValidationError

    from surrogym_shared.faults import first_fault

    return first_fault(error) if isinstance(error, ValidationError) else str(error)
