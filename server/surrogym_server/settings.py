"""Settings of one server, read once from the environment (``SURROGYM_*``) and the command line."""

from __future__ import annotations

import ipaddress
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, Self
from urllib.parse import urlsplit

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, FilePath, ValidationError, model_validator

from surrogym_server.errors import InvalidInput
from surrogym_server.logs import LogFormat
from surrogym_shared.faults import first_fault
from surrogym_shared.patterns import IN_WORDS, TOKEN
from surrogym_shared.secret_files import parse_token, tokens_in
from surrogym_shared.wire import MAX_LANES, Role

PREFIX = "SURROGYM_"
LOCAL_NAMES = ("localhost",)
MIN_TOKEN_LENGTH = 8

LogLevel = Literal["critical", "error", "warning", "info", "debug"]


def _without_path(url: str) -> str:
    if not re.fullmatch(r"https?://[^/@?#]+/?", url):
        raise ValueError(
            f"expected an address without a path, such as https://surrogates.example.org, got {url!r}: remove the path"
        )
    return url


def _http(url: str) -> str:
    if not re.fullmatch(r"https?://[^/@?#\s]+(/\S*)?", url):
        raise ValueError(
            "expected an address that begins with http:// or https:// and a host, without a user name, got another "
            "form: correct it"
        )
    return url


class Settings(BaseModel):
    """Settings of a server. Each field can be set by the environment variable ``SURROGYM_<FIELD>``."""

    model_config = ConfigDict(extra="forbid", frozen=True, hide_input_in_errors=True)

    host: str = "127.0.0.1"
    port: Annotated[int, Field(ge=0, le=65_535, description="port to listen on; 0 takes any free port")] = 8000
    database: str = Field(default="surrogym.db", min_length=1, description="SQLite file, or a SQLAlchemy URL")
    files: Annotated[
        Path | None,
        Field(description="folder for the files of policies. None: beside a SQLite file, or in PostgreSQL"),
    ] = None
    public_url: Annotated[
        Annotated[str, AfterValidator(_without_path)] | None,
        Field(description="address under which browsers reach this server behind a proxy"),
    ] = None
    tokens: dict[str, Role] = Field(default_factory=dict, description="role of each bearer token")
    token_file: Path | None = Field(default=None, description="file with one token a line, alone or as role:token")
    insecure: bool = Field(default=False, description="allow another address than loopback without a token")
    tls_certificate: FilePath | None = Field(default=None, description="file with the certificate chain, as PEM")
    tls_key: FilePath | None = Field(default=None, description="file with the certificate's private key, as PEM")
    device: Annotated[
        Literal["cpu", "cuda"], Field(description="device that computes steps of sessions; fits use the CPU")
    ] = "cpu"
    threads: Annotated[
        int, Field(ge=1, le=1024, description="threads of one torch operation, and of a compiled step of a large model")
    ] = 1
    engine: Annotated[
        Literal["local", "ray"], Field(description="where sessions run: in this process, or in a Ray cluster")
    ] = "local"
    ray_address: Annotated[
        str, Field(min_length=1, description="address of the Ray cluster; auto finds a running one")
    ] = "auto"
    ray_hosts: Annotated[
        int,
        Field(ge=1, le=1_000, description="number of processes in the Ray cluster that run sessions, each on a CPU"),
    ] = 2
    ray_fit_gpus: Annotated[
        float, Field(ge=0, description="number of GPUs of the Ray cluster that each fit reserves; 0 reserves none")
    ] = 0.0
    ray_checkpoint_seconds: Annotated[
        float, Field(ge=0.01, le=3_600, description="seconds between two checkpoints of a session in the Ray cluster")
    ] = 1.0
    ray_lease_seconds: Annotated[
        float, Field(ge=1, le=3_600, description="seconds after which another process continues a dead one's sessions")
    ] = 10.0
    session_idle_seconds: Annotated[
        float, Field(gt=0, description="seconds without a request after which a session expires")
    ] = 3_600.0
    fit_seconds: Annotated[
        float, Field(gt=0, description="seconds that a fit may take; a fit that takes longer is stopped")
    ] = 3_600.0
    fit_workers: Annotated[
        int, Field(ge=1, le=256, description="number of fits that run at the same time, each in a process")
    ] = 1
    max_body_bytes: Annotated[
        int, Field(ge=1_024, description="largest size of one request body, frame or file, in bytes")
    ] = 32 * 1024 * 1024
    max_bodies_bytes: Annotated[
        int, Field(ge=1_024, description="largest size of all request bodies at the same time, in bytes")
    ] = 256 * 1024 * 1024
    max_connections: Annotated[int, Field(ge=1, description="largest number of open connections")] = 16_384
    request_seconds: Annotated[
        float, Field(gt=0, description="seconds within which a request must arrive completely")
    ] = 30.0
    max_sessions: Annotated[int, Field(ge=1, description="largest number of open sessions")] = 256
    max_sessions_mib: Annotated[
        int, Field(ge=1, description="largest memory of all sessions together, lanes and kept replies, in MiB")
    ] = 2_048
    max_waiting: Annotated[
        int, Field(ge=1, description="largest number of requests of sessions that run or wait at the same time")
    ] = 1_024
    max_lanes: Annotated[
        int, Field(ge=1, le=MAX_LANES, description="largest number of lanes (parallel environments) of one session")
    ] = 65_536
    policies_mib: Annotated[
        int, Field(ge=1, description="largest size of all files of a surrogate's policies together, in MiB")
    ] = 1_024
    drift_webhook: Annotated[
        Annotated[str, AfterValidator(_http)] | None,
        Field(description="address to which each report of drift is posted as JSON. None: to no address"),
    ] = None
    sweep_seconds: Annotated[
        float, Field(gt=0, description="seconds between two searches for expired leases and sessions")
    ] = 1.0
    log_level: Annotated[LogLevel, Field(description="lowest level of the records that are logged")] = "info"
    log_format: Annotated[
        LogFormat, Field(description="text: each log record is a line of text; json: it is a JSON object")
    ] = "text"

    @model_validator(mode="after")
    def _closed_by_default(self) -> Self:
        short = [token for token in self.tokens if len(token) < MIN_TOKEN_LENGTH]
        if short:
            raise ValueError(
                f"expected tokens of at least {MIN_TOKEN_LENGTH} characters, got one of {len(short[0])}: choose longer "
                "tokens"
            )
        if not all(re.fullmatch(TOKEN, token) for token in self.tokens):
            raise ValueError(f"expected tokens of {IN_WORDS[TOKEN]}, got one with others: no header can contain it")
        if not (self.tokens or self.insecure or self.loopback):
            raise ValueError(
                f"host {self.host} can be reached from other machines: expected a token, got none: set SURROGYM_TOKEN, "
                "or allow everything to everybody by --insecure"
            )
        return self

    @model_validator(mode="after")
    def _certificate_with_its_key(self) -> Self:
        if (self.tls_certificate is None) != (self.tls_key is None):
            came = "the key" if self.tls_certificate is None else "the certificate"
            raise ValueError(f"TLS: expected a certificate and its private key, got {came} alone: give both")
        return self

    @property
    def loopback(self) -> bool:
        """Whether only programs on this machine can reach the server's address (loopback)."""
        if self.host in LOCAL_NAMES:
            return True
        try:
            return ipaddress.ip_address(self.host).is_loopback
        except ValueError:
            return False

    @property
    def host_names(self) -> tuple[str, ...]:
        """Host names under which clients reach this server: ``host``, and the host of ``public_url`` if it is set."""
        public = None if self.public_url is None else urlsplit(self.public_url).hostname
        return (self.host,) if public is None else (self.host, public)

    @property
    def database_url(self) -> str:
        """Address of the database as a SQLAlchemy URL. A setting ``database`` without "://" is the path of a SQLite
        file."""
        return self.database if "://" in self.database else f"sqlite:///{self.database}"


def read_settings(environment: Mapping[str, str], **options: Any) -> Settings:
    """Read the settings from environment variables. ``options`` that are not None replace these.

    Args:
        environment: usually ``os.environ``. ``SURROGYM_TOKEN`` is an admin token, ``SURROGYM_TOKENS`` a list
            like ``sample:secret1,train:secret2``, ``SURROGYM_TOKEN_FILE`` a file with one such entry a line.
        options: values of fields of ``Settings``, usually from the command line.

    Raises:
        InvalidInput: a value is invalid, or the file of tokens can't be read.
    """
    fields = {
        name: environment[PREFIX + name.upper()]
        for name in Settings.model_fields
        if name != "tokens" and PREFIX + name.upper() in environment
    }
    given = fields | {name: value for name, value in options.items() if value is not None}
    file = given.pop("token_file", None) or None
    tokens = _read_tokens(environment, file)
    try:
        return Settings.model_validate({"tokens": tokens, **given, "token_file": file})
    except ValidationError as error:
        raise InvalidInput(_one_sentence(error)) from error


def _read_tokens(environment: Mapping[str, str], file: str | Path | None) -> dict[str, Role]:
    entries = environment.get(f"{PREFIX}TOKENS", "").split(",")
    if token := environment.get(f"{PREFIX}TOKEN"):
        entries.append(f"admin:{token}")
    try:
        tokens = dict(parse_token(entry.strip()) for entry in entries if entry.strip())
    except ValueError as error:
        raise InvalidInput(str(error)) from None
    if file is None:
        return tokens
    try:
        return tokens | tokens_in(Path(file))
    except OSError as error:
        raise InvalidInput(f"the token file {str(file)!r} can't be read: {error}; correct --token-file") from error
    except ValueError as error:
        raise InvalidInput(f"the token file {str(file)!r} can't be used: {error}") from None


def _one_sentence(error: ValidationError) -> str:
    said, place = first_fault(error), error.errors()[0]["loc"]
    return f"setting {said}" if place and place != ("tokens",) else said.removeprefix("tokens: ")
