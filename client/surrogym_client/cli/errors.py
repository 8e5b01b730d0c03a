"""What a command tells a person when it can't do its work: one sentence, never a traceback."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from surrogym_client.errors import SurrogymClientError

EXTRAS = {
    "server": ("alembic", "fastapi", "psycopg", "safetensors", "scipy", "sqlalchemy", "starlette", "uvicorn"),
    "train": ("matplotlib", "stable_baselines3", "tensorboard", "torch"),
    "export": ("onnx", "onnxruntime", "onnxscript"),
    "render": ("moviepy", "pygame"),
    "trackers": ("mlflow", "wandb"),
    "mujoco": ("mujoco", "imageio"),
}
START_SERVER = "start one with surrogym serve, or name another by --server or SURROGYM_URL"
GIVE_TOKEN = "give a token of this server by SURROGYM_TOKEN or --token-file"


class CommandError(Exception):
    """A command can't do what was asked; ``str(error)`` is the sentence for the person."""


def sentence(error: Exception) -> str | None:
    """The sentence for an error that a person can do something about; None for a defect of the program."""
    from pydantic import ValidationError

    from surrogym_client.errors import SurrogymClientError
    from surrogym_client.original.errors import OriginalError
    from surrogym_shared.surrogate_file import NotASurrogateFile

    match error:
        case SurrogymClientError():
            return f"{error}{_way_out(error)}"
        case CommandError() | OriginalError() | NotASurrogateFile():
            return str(error)
        case ModuleNotFoundError(name=str(name)):
            return _missing(name.partition(".")[0])
        case ValidationError():
            return invalid(error)
        case OSError(filename=str(path), strerror=str(reason)):
            return f"{path}: {reason}"
        case _:
            return None


def _way_out(error: SurrogymClientError) -> str:
    """What to do about what a server, or none, has said."""
    from surrogym_client import errors

    match error:
        case errors.RequestTimeout():
            return "; surrogym doctor says how far away it is"
        case errors.ServerUnreachable():
            return f"; {START_SERVER}"
        case errors.ProtocolMismatch():
            return "; surrogym doctor says more"
        case errors.Unauthenticated():
            return f"; {GIVE_TOKEN}"
        case errors.Forbidden():
            return "; surrogym doctor says what this token may do"
        case errors.UnknownSurrogate():
            return "; surrogym status lists those there are"
        case _:
            return ""


def invalid(error: Exception) -> str:
    """The first thing that is wrong with a model, with its place."""
    from pydantic import ValidationError

    if not isinstance(error, ValidationError):
        return str(error)
    first = error.errors()[0]
    where = ".".join(str(part) for part in first["loc"])
    message = first["msg"].removeprefix("Value error, ")
    return f"{where}: {message}" if where else message


def _missing(module: str) -> str | None:
    for extra, modules in EXTRAS.items():
        if module in modules:
            return f"this needs {module}, which is not installed: pip install 'surrogym[{extra}]'"
    return None
