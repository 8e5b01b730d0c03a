"""A program that crashes or hangs at random steps costs attempts of queries: no sample and no query is lost, none is
there twice, and the ledger counts each crash."""

from __future__ import annotations

import json
import shlex
import shutil
import subprocess
import sys
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from support import crashing
from support.chaos import SEED
from support.programs import program
from support.server import running_server
from surrogym_client.transport import Api
from surrogym_sampler import original
from surrogym_sampler.original.executables import name_of
from surrogym_shared.spec import EnvironmentSpec

EXAMPLES = Path(__file__).parents[2] / "examples" / "executables"
PROBABILITY = 0.5  # of a fault at a step
HANGS = 1  # in a design
STEP_LIMIT = 2.0  # s, of a hang
BROKEN = "different queries in a row"  # the documented end of a sampler


def cartpole(folder: Path) -> str:
    """The cart-pole in C; without a compiler, a line in Python."""
    if (compiler := shutil.which("cc")) is None:
        return program(folder)
    built = folder / "cartpole"
    source = EXAMPLES / "cartpole.c"
    subprocess.run([compiler, "-O2", "-ffp-contract=off", "-o", str(built), str(source), "-lm"], check=True)
    return shlex.join([str(built), str(EXAMPLES / "cartpole.json")])


def specification(command: str) -> EnvironmentSpec:
    opened = original.make(name_of(command))
    opened.close()
    spec = opened.spec()
    design = spec.design.model_copy(update={"initial": 4, "budget": 4, "monte_carlo": 64})
    return spec.model_copy(update={"design": design})


def sample(url: str, name: str, command: str) -> tuple[dict[str, int], int]:
    """Run samplers until the design has ended; what the last one reports, and how many ended by themselves before."""
    options = ["--exec", command, "--step-limit", str(STEP_LIMIT), "--until-done", "--batch", "16", "--json"]
    call = [sys.executable, "-m", "surrogym", "sample", name, "--server", url, *options]
    said, ends = "", 0
    while True:
        ended = subprocess.run(call, capture_output=True, text=True, check=False)
        said += ended.stderr
        if ended.returncode == 0:
            assert "Traceback" not in said
            assert "fault: abort" in said, "the program's standard error is the sampler's"
            return json.loads(ended.stdout), ends
        assert BROKEN in ended.stderr
        ends += 1


def judge(api: Api, name: str, reported: dict[str, int], ends: int, noted: Counter[str]) -> Counter[str]:
    """Hold a surrogate against the program's diary; what it came to."""
    queries, samples, ledger = api.queries(name), list(api.samples(name)), api.surrogate(name).ledger
    status = Counter(query.status for query in queries)
    assert status.keys() <= {"answered", "set_aside"}, "no query is lost"
    assert Counter(sample.query_id for sample in samples) == Counter(q.id for q in queries if q.status == "answered")
    assert len(samples) == ledger.total <= noted["answered"] + noted[crashing.BETWEEN]
    within = sum(noted[kind] for kind in crashing.CRASHES)
    assert within <= ledger.failed == ledger.unresolved, "each crash within a step is counted"
    attempts = ledger.total + ledger.failed
    assert noted["set"] <= attempts <= noted["set"] + noted[crashing.BETWEEN], "no attempt is hidden or made up"
    if not ends:
        assert (reported["steps"], reported["failed"]) == (ledger.total, ledger.failed)
    errors = [query.error or "" for query in queries]
    assert all(error.endswith("fault: abort") for error in errors if "exit code -6" in error)
    return Counter(
        crashes=within, between=noted[crashing.BETWEEN], hangs=noted["hang"], failed=ledger.failed, ends=ends,
        samples=len(samples), set_aside=status["set_aside"],
    )  # fmt: skip


@pytest.mark.timeout(3_600)
@pytest.mark.parametrize(
    ("plant", "crashes", "queries"),
    [
        pytest.param(cartpole, 5, 24, id="few"),
        pytest.param(program, 1_000, 200, id="thousand"),  # its models are fitted fast
    ],
)
def test_crashes_of_an_environment_program_lose_no_sample_and_no_query(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], plant: Callable[[Path], str], crashes: int, queries: int
):
    command, total, designs = plant(tmp_path), Counter[str](), 0
    spec = specification(command)
    source = np.random.default_rng(SEED)
    with running_server(tmp_path) as server, Api(server.url) as api:
        while total["crashes"] + total["between"] < crashes:
            name, diary = f"run-{designs}", tmp_path / f"diary-{designs}"
            api.create_surrogate(name, spec)
            states = source.uniform(-0.1, 0.1, (queries, len(spec.coordinates)))
            api.add_queries(name, states.tolist(), [[float(n % 2)] for n in range(queries)])
            faults = [str(diary), f"{SEED} {designs}", str(PROBABILITY), str(HANGS)]
            crashing_command = [sys.executable, "-I", "-S", crashing.__file__, *faults]
            reported, ends = sample(server.url, name, f"{shlex.join(crashing_command)} {command}")
            total += judge(api, name, reported, ends, Counter(diary.read_text().splitlines()))
            designs += 1
        assert "Traceback" not in server.log
    with capsys.disabled():
        print(f"\n{designs} designs: {dict(total)}")
