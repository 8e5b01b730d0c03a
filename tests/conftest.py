"""Fixtures of all rooms."""

from __future__ import annotations

import gc
import os
import shutil
import signal
from collections.abc import Iterator
from functools import cache
from multiprocessing import context
from pathlib import Path
from typing import Any

os.environ.setdefault("RAY_AUTH_MODE", "disabled")  # a token in the home folder would change it between two clusters
if "DISPLAY" not in os.environ:
    os.environ.setdefault("MUJOCO_GL", "egl")  # read when mujoco is imported, so before everything else

import hypothesis
import pytest
import torch
import typer.main
import typer.testing

import surrogym.cli
from support.long import TESTS, Long
from support.nursery import CONTEXTS, FORKS, await_shared, contexts_of_forks, one_thread, share, use_shared
from support.server import ServerProcess, running_server
from support.teaching import teach
from surrogym_client.transport import Api
from surrogym_sampler.original.classic import pendulum
from surrogym_server.engine.local import Compiling

# The same examples in every run, on machines of any speed, and none kept in the checkout.
hypothesis.settings.register_profile(
    "surrogym",
    deadline=None,
    derandomize=True,
    database=None,
    suppress_health_check=[hypothesis.HealthCheck.too_slow],
)
hypothesis.settings.load_profile("surrogym")


# Hundreds of tests run a command, and to assemble all of them takes a tenth of a second each time.
surrogym.cli.build = cache(surrogym.cli.build)
typer.main.get_command = typer.testing._get_command = cache(typer.main.get_command)

# Thousands of databases flush each commit, which costs nothing in memory.
MEMORY, ROOM = Path("/dev/shm"), 4 * 2**30  # bytes that must be free in it
if MEMORY.is_dir() and shutil.disk_usage(MEMORY).free > ROOM:
    os.environ.setdefault("PYTEST_DEBUG_TEMPROOT", str(MEMORY))

# A run in a shell's background ignores Ctrl-C, and one under nohup ignores hang-ups. So would every program that a test
# starts and signals.
for number, usual in ((signal.SIGINT, signal.default_int_handler), (signal.SIGHUP, signal.SIG_DFL)):
    if signal.getsignal(number) is signal.SIG_IGN:
        signal.signal(number, usual)

ADDRESS = "address of the process that is forked"  # key under which a worker of pytest-xdist receives it
WHOLE = pytest.StashKey[bool]()  # whether this run is one of all tests
LASTING = ("slow", "e2e", "timeout")  # marks; a limit of its own is one of more time


@pytest.hookimpl(tryfirst=True)  # before marks select
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Mark what ``long.toml`` lists. Files with tests that take long come first: one that begins last leaves the other
    workers with nothing to do."""
    nodes = {item: os.path.relpath(item.path, TESTS) + item.nodeid[item.nodeid.index("::") :] for item in items}
    long = Long()
    for item, node in nodes.items():
        if long.lines_of(node):
            item.add_marker(pytest.mark.long)
    if config.stash[WHOLE] and (unknown := long.unknown(nodes.values())):
        raise pytest.UsageError(f"tests/long.toml: expected tests, got lines that name none: {unknown}")
    lasting = {item.path for item in items if any(item.get_closest_marker(mark) for mark in LASTING)}
    items.sort(key=lambda item: (item.path not in lasting, item.path))


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Iterator[None]:
    """What was imported stays: looking through a million objects for garbage takes most of a second each time."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()


def pytest_configure(config: pytest.Config) -> None:
    """Compile steps once, before the first test: a dozen servers that do so at once outlast what tests wait for.

    Workers collect their tests meanwhile, all in the same order: xdist refuses to run them otherwise. What another
    checkout has compiled is of no use to this one.
    """
    config.stash[WHOLE] = [Path(argument).resolve() for argument in config.args] == [TESTS]
    if hasattr(config, "workerinput"):
        if address := config.workerinput[ADDRESS]:
            use_shared(address)
    elif not (FORKS and getattr(config.option, "numprocesses", None)):
        ahead = Compiling()
        ahead.start()
        ahead.wait()


@pytest.hookimpl(optionalhook=True)
def pytest_configure_node(node: Any) -> None:
    node.workerinput[ADDRESS] = share() if FORKS else None


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_node_collection_finished() -> None:
    if FORKS:
        await_shared()


@pytest.fixture(scope="session", autouse=True)
def _one_thread() -> None:
    """Once all libraries are loaded."""
    one_thread()


@pytest.fixture(scope="session", autouse=True)
def _forks() -> Iterator[None]:
    """Let processes of fits, of environments and of samplers be forks of one that has imported what they need."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(context, "_concrete_contexts", contexts_of_forks())
        yield


@pytest.fixture
def cold(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let processes import what they need, as those of a user do."""
    monkeypatch.setattr(context, "_concrete_contexts", CONTEXTS)


@pytest.fixture(params=["cpu", "cuda"])
def device(request: pytest.FixtureRequest) -> torch.device:
    """Every device that steps can be computed on; a machine without the one leaves its tests out, and says so."""
    if request.param == "cuda" and not torch.cuda.is_available():
        pytest.skip("torch has no CUDA here")
    return torch.device(request.param)


@pytest.fixture(scope="session")
def server_process(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ServerProcess]:
    """One real server for the whole run; its tests keep apart by the names of their surrogates."""
    with running_server(tmp_path_factory.mktemp("server")) as server:
        yield server


@pytest.fixture(scope="session")
def pendulum_server(server_process: ServerProcess) -> ServerProcess:
    """The server, with a surrogate ``pendulum`` that has learned from a dozen real steps."""
    with Api(server_process.url) as api:
        teach(api, "pendulum", pendulum(), queries=12)
    return server_process
