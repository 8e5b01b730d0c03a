"""FMUs made there and then by pythonfmu, and damaged copies of them."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import zipfile
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from surrogym_sampler.original.describing import describe
from surrogym_shared.spec import DeclaredReward, EnvironmentSpec, Quantity, RewardTerm, Term

EXAMPLES = Path(__file__).parents[2] / "examples" / "fmus"
DESCRIPTION = "modelDescription.xml"
STATES = ("--handle-state", "--serialize-state")

MOODY = """
import os, time
from pythonfmu import Fmi2Causality, Fmi2Initial, Fmi2Slave, Real

class Moody(Fmi2Slave):
    def __init__(self, **options):
        super().__init__(**options)
        self.push, self.x = 0.0, 0.25
        self.register_variable(Real("push", causality=Fmi2Causality.input))
        self.register_variable(Real("x", causality=Fmi2Causality.output, initial=Fmi2Initial.exact))

    def do_step(self, current_time, step_size):
        print("native code prints what it likes", flush=True)
        if self.push == 1.5:
            os.abort()
        if self.push == 2.0:
            time.sleep(3600)
        if self.push == 3.0:
            self.x = float("nan")
        if self.push == 4.0:
            raise ValueError("no solution")
        self.x += 0.5 * step_size * self.push
        return True
"""
STUBBORN = """
from pythonfmu import Fmi2Causality, Fmi2Initial, Fmi2Slave, Real

class Stubborn(Fmi2Slave):
    def __init__(self, **options):
        super().__init__(**options)
        self.push, self.x = 0.0, 0.25
        self.register_variable(Real("push", causality=Fmi2Causality.input))
        self.register_variable(Real("x", causality=Fmi2Causality.output, initial=Fmi2Initial.exact, setter=print))

    def do_step(self, current_time, step_size):
        self.x += 0.5 * step_size * self.push
        return True
"""
OF_VERSION_3 = """
from pythonfmu3 import DefaultExperiment, Float64, Fmi3Causality, Fmi3Initial, Fmi3Slave, Fmi3Variability

class Heater(Fmi3Slave):
    def __init__(self, **options):
        super().__init__(**options)
        self.default_experiment = DefaultExperiment(start_time=0.0, stop_time=60.0, step_size=0.5)
        self.power, self.heat, self.loss, self.time = 0.0, 20.0, 0.1, 0.0
        kinds = Fmi3Variability
        self.register_variable(Float64("time", causality=Fmi3Causality.independent, variability=kinds.continuous))
        self.register_variable(Float64("power", causality=Fmi3Causality.input, variability=kinds.continuous))
        self.register_variable(
            Float64("heat", causality=Fmi3Causality.output, variability=kinds.continuous, initial=Fmi3Initial.exact)
        )
        self.register_variable(Float64("loss", causality=Fmi3Causality.parameter, variability=kinds.tunable))

    def do_step(self, current_time, step_size):
        self.heat += step_size * (self.power - self.loss * (self.heat - 20.0))
        return True
"""


def build(script: Path, folder: Path, *options: str, builder: str = "pythonfmu") -> Path:
    """Build the FMU of a script into a folder, in a process of its own."""
    before = set(folder.glob("*.fmu"))
    command = [sys.executable, "-B", "-m", builder, "build", "-f", str(script), "-d", str(folder), *options]
    subprocess.run(command, check=True, capture_output=True, env=os.environ | {"PYTHONWARNINGS": "ignore"})
    (made,) = set(folder.glob("*.fmu")) - before
    return made


def build_text(text: str, name: str, folder: Path, *options: str, builder: str = "pythonfmu") -> Path:
    """Build the FMU of a program's text."""
    script = folder / f"{name}.py"
    script.write_text(text, encoding="utf-8")
    return build(script, folder, *options, builder=builder)


def changed(fmu: Path, copy: Path, replaced: Mapping[str, str], left_out: str = "\0", moved: str = "linux64") -> Path:
    """A copy of an FMU with words of its description replaced, without some files, with code for another platform."""
    with zipfile.ZipFile(fmu) as old, zipfile.ZipFile(copy, "w") as new:
        for name in old.namelist():
            content = old.read(name)
            if name == DESCRIPTION:
                text = content.decode()
                for word, other in replaced.items():
                    assert word in text
                    text = text.replace(word, other)
                content = text.encode()
            if not name.startswith(left_out):
                new.writestr(name.replace("linux64", moved), content)
    return copy


def mapping(folder: Path, **choices: object) -> str:
    """The name of an FMU with choices in a JSON file."""
    file = folder / "plant.json"
    file.write_text(json.dumps(choices), encoding="utf-8")
    return f"fmu:{file}"


def squared(name: str, weight: float = 1.0, wanted: float = 0.0) -> RewardTerm:
    """-weight * (q - wanted)^2."""
    of = Term.linear(**{name: 1.0}) + Term.constant(-wanted)
    return RewardTerm(weight=-weight, shape="square", of=(Quantity(term=of),))


def rewarded(name: str, *terms: RewardTerm, steps: int = 60) -> EnvironmentSpec:
    """The drafted specification of an FMU, with a declared reward."""
    reward = DeclaredReward(kind="declared", timing="after", terms=terms)
    return describe(name, steps).spec.model_copy(update={"reward": reward})


def bits(*rows: object) -> bytes:
    """Numbers bit for bit."""
    return np.asarray(rows, dtype=np.float64).tobytes()
