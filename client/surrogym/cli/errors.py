"""Errors of a command as one sentence for a person, without a traceback."""

from __future__ import annotations

import errno
from typing import TYPE_CHECKING

from surrogym_client.runtime.ways_out import GIVE_TOKEN, START_SERVER, missing

if TYPE_CHECKING:
    from surrogym_client.errors import SurrogymClientError

FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)  # from a file that is open: such an error does not have its name


class CommandError(Exception):
    """A command can't do its work. ``str(error)`` is the sentence to show."""


def sentence(error: Exception) -> str | None:
    """Return the sentence for an error that a person can act on; None for a defect of the program."""
    from pydantic import ValidationError

    from surrogym_client.environments.pictures import NotRenderable
    from surrogym_client.errors import SurrogymClientError
    from surrogym_client.runtime.ray_cluster import NoCluster
    from surrogym_sampler.original.errors import OriginalError
    from surrogym_shared.c_compiler import CannotCompile
    from surrogym_shared.logs.errors import UnusableLog
    from surrogym_shared.surrogate_file import NotASurrogateFile

    match error:
        case SurrogymClientError():
            return f"{error}{_way_out(error)}"
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


def _way_out(error: SurrogymClientError) -> str:
    """Return advice on what to do about an error of the server or the connection."""
    from surrogym_client import errors

    match error:
        case errors.RequestTimeout():
            return "; surrogym doctor measures how long it takes to answer"
        case errors.ServerUnreachable():
            return f"; {START_SERVER}"
        case errors.ProtocolMismatch():
            return "; surrogym doctor shows more"
        case errors.Unauthenticated():
            return f"; {GIVE_TOKEN}"
        case errors.Forbidden():
            return "; surrogym doctor shows what this token may do"
        case errors.UnknownSurrogate():
            return "; surrogym status lists the existing ones"
        case _:
            return ""


def invalid(error: Exception) -> str:
    """Describe the first validation error of a model, with its place."""
    from pydantic import ValidationError

    from surrogym_shared.faults import first_fault

    return first_fault(error) if isinstance(error, ValidationError) else str(error)
