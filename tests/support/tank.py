"""A tank whose pump can wear, as logs of real steps, and a surrogate of it that has learned from a log."""

from __future__ import annotations

import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from surrogym_client.surrogates.waiting import wait_for_model
from surrogym_client.transport import Api
from surrogym_sampler.logs import import_log, read_log
from surrogym_shared import wire
from surrogym_shared.network import Network
from surrogym_shared.spec import BoxAction

HEADING = "time,level,action,reward"


def lines(count: int, seed: int, worn_from: int | None = None) -> list[str]:
    """Rows of a log with a step each second, the last of which has no next state. A worn pump gives 30 % less."""
    rng, level, rows = np.random.default_rng(seed), 1.0, []
    for t in range(count):
        u = rng.uniform(-1, 1)
        rows.append(f"{t},{level:.6f},{u:.6f},{-((level - 1) ** 2):.6f}")
        pump = 0.7 if worn_from is not None and t >= worn_from else 1.0
        level += 0.2 * (1 + pump * u - level) + 0.01 * rng.standard_normal()
    return rows


def write(path: Path, rows: list[str], heading: str = HEADING) -> Path:
    path.write_text("\n".join([heading, *rows]) + "\n", encoding="utf-8")
    return path


@contextmanager
def watched_tank(url: str, folder: Path) -> Iterator[str]:
    """The name of a surrogate with a model of the tank and a trusted policy of version 1."""
    name = f"tank-{uuid.uuid4().hex[:8]}"
    log = write(folder / "learned.csv", lines(80, seed=1))
    drafted = {"sampling_period": 1.0, "action": BoxAction(low=(-1.0,), high=(1.0,))}
    spec = read_log(log).spec.model_copy(update=drafted)
    import_log(log, register=name, spec=spec, url=url)
    vector = np.zeros(Network.size(spec, 4))
    Network.of(spec, np.zeros(1), np.ones(1), 4, vector).save(folder / "policy.zip")
    with Api(url) as api:
        wait_for_model(api, name, 120)
        promise = wire.PolicyPromise(median=-1, low=-2, high=0)
        card = wire.PushedCard(spec=api.surrogate(name).spec, promise=promise, trusted=True, reason="an audit passed")
        api.policies.push(name, card, [], "zip", (folder / "policy.zip").read_bytes())
        api.policies.put_alias(name, "production", 1)
        yield name
        api.delete_surrogate(name)
