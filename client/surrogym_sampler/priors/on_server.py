"""A simulator as the prior of a surrogate on a server. The server also learns the model of the simulator."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from uuid import uuid4

from surrogym_client.errors import UnknownSurrogate
from surrogym_client.surrogates.transfer import export_surrogate
from surrogym_client.surrogates.waiting import wait_for_model
from surrogym_client.transport.api import Api
from surrogym_sampler.priors.prior import Careful, Progress, SimulatorPrior
from surrogym_sampler.queries.settings import SamplerSettings
from surrogym_sampler.queries.worker import Sampler
from surrogym_shared.spec import EnvironmentSpec
from surrogym_shared.surrogate_file import SurrogateFile
from surrogym_shared.wire import SurrogateView

BATCH = 64  # number of queries that are claimed at once
LONGEST_FIT = 1_800.0  # largest number of seconds for fitting the simulator's model
MARK = ".simulator-"  # part of the name of the temporary surrogate that learns the simulator's model
TOKEN = 8  # number of random hexadecimal digits at the end of the temporary surrogate's name
MOST_OF_NAME = 64 - len(MARK) - TOKEN


class ServerPrior(SimulatorPrior):
    """A simulator whose model a server learns, in a temporary surrogate that is deleted afterwards.

    Args:
        api: the connection to the server; the token needs the role admin.
        name: name of the surrogate that gets the prior.
        simulator, spec, parameters, steps: as for ``SimulatorPrior``. Wrong values raise the same errors as there.
    """

    def __init__(
        self,
        api: Api,
        name: str,
        simulator: str,
        spec: EnvironmentSpec,
        parameters: Sequence[str] = (),
        *,
        steps: int | None = None,
    ) -> None:
        super().__init__(simulator, spec, parameters, steps=steps)
        self._api = api
        self._name = f"{name[:MOST_OF_NAME]}{MARK}{uuid4().hex[:TOKEN]}"

    def learn(self, say: Progress) -> tuple[SurrogateFile, float]:
        """Let the server learn a model of the simulator from simulated steps, whose number is the attribute ``steps``,
        and return the model and its confidence index. Progress is reported to ``say``.

        Raises:
            SurrogymClientError: the server can't be reached, or refuses a request.
        """
        try:
            self._api.create_surrogate(self._name, self.spec)
            taken = 0

            def count(*_: object) -> None:
                nonlocal taken
                taken += 1
                say(0.5 * min(1.0, taken / self.steps), f"{taken} of {self.steps} steps of the simulator")

            settings = SamplerSettings(until_done=True, max_queries=self.steps, batch=BATCH)
            Sampler(self._api, self._name, Careful(self.simulator), settings, report=count).run()
            view = wait_for_model(self._api, self._name, LONGEST_FIT, lambda view: say(0.75, _words(view)))
            return export_surrogate(self._api, self._name), view.confidence_index or 0.0
        finally:
            self._remove()

    def _remove(self) -> None:
        with suppress(UnknownSurrogate):
            self._api.delete_surrogate(self._name)


def _words(view: SurrogateView) -> str:
    return f"a model of the simulator is being fitted to {view.samples} of its steps"
