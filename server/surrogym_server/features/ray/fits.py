"""Fits as tasks of a Ray cluster: each round of a design on any machine with a free CPU."""

from __future__ import annotations

import asyncio
import platform
from collections.abc import Awaitable, Mapping
from contextlib import suppress
from typing import Any, cast

import ray
from ray.exceptions import RayError, RayTaskError, TaskCancelledError

from surrogym_server.engine.design_job import DesignJob, DesignResult, run_design_job
from surrogym_server.engine.fits import Failure, Function, done, error_of
from surrogym_server.engine.port import Compute
from surrogym_server.errors import PluginFailed, Unavailable
from surrogym_server.features.ray.host import versions
from surrogym_server.plugins import in_one_line

RETRIES = 1  # how often the fit of a design is tried again if its process or machine died


class RayFits(Compute):
    """Computes each job as a task of Ray. When this process ends, for any reason, Ray ends its tasks.

    Args:
        function: computes a job.
        gpus: number of the cluster's GPUs for each job, for example 0.5. The job's process sees no other GPUs.
    """

    def __init__(self, function: Function = run_design_job, gpus: float = 0.0) -> None:
        self._function = function
        self._running: set[Any] = set()
        self._task: Any = ray.remote(num_cpus=1, num_gpus=gpus, max_retries=RETRIES)(_done_there)

    def start(self) -> None:
        """Do nothing, because Ray starts the processes of tasks itself."""

    async def run(self, job: DesignJob) -> DesignResult:
        asked = self._task.remote(self._function, job, versions())
        self._running.add(asked)
        try:
            outcome = await cast(Awaitable[Any], asked)
        except RayTaskError as error:  # the fit's result, which a plug-in may have made, can't be pickled
            raise PluginFailed(in_one_line(error.cause or error)) from error
        except TaskCancelledError as error:
            raise Unavailable(
                "the fit was ended, because this server stops: it is repeated after the next start"
            ) from error
        except RayError as error:
            raise Unavailable(
                f"the process or machine of a fit died: {in_one_line(error)}; the fit is tried again"
            ) from error
        except asyncio.CancelledError:
            await asyncio.to_thread(_end, asked)
            raise
        finally:
            self._running.discard(asked)
        if isinstance(outcome, Failure):
            raise error_of(outcome)
        return cast(DesignResult, outcome)

    def close(self) -> None:
        for asked in list(self._running):
            _end(asked)
        self._running.clear()


def _end(asked: Any) -> None:
    """Kill the process of a Ray task."""
    with suppress(RayError, ValueError):
        ray.cancel(asked, force=True)


def _done_there(function: Function, job: DesignJob, expected: Mapping[str, str]) -> DesignResult | Failure:
    """Compute a job in a process of the cluster. Return a ``Failure`` if this process has other versions of Python or
    of packages than those in ``expected``."""
    for name, here in versions().items():
        if here != expected[name]:
            wrong = (
                f"expected {name} {expected[name]} on every machine of the cluster, got {here} on {platform.node()}: "
                "install the same version there"
            )
            return Failure(PluginFailed, wrong, "")
    return done(function, job)
