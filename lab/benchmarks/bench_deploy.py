"""A policy on a controller: C beside Python, time, memory, other processors, and returns.

python lab/benchmarks/bench_deploy.py                      # all parts
python lab/benchmarks/bench_deploy.py equal time           # some
python lab/benchmarks/bench_deploy.py returns --policy tank.zip --env tank:Tank    # and a trained policy

Parts: ``equal`` (random and visited states, edges, NaN and infinities), ``strict`` (warnings, sanitizers, symbols,
recursion, stack), ``time`` (a decision beside onnxruntime and torch), ``arm`` (vectors under qemu-user; flash, RAM and
stack of a Cortex-M4), ``returns`` (100 episodes of a policy with lags and of a plant with stops). A compiler or an
emulator that is not on this machine is named, and its part is left out.
"""

from __future__ import annotations

import ctypes
import json
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))
sys.path.insert(0, str(Path(__file__).parents[2] / "examples"))

import numpy as np
from common import parser, started

from support.compilers import SANITIZED, STRICT, Compiled, called_by_name, calls, recursive
from support.controllers import LEARNERS, learner, network, plant
from surrogym_sampler.original.actions import decode_actions
from surrogym_sampler.original.episodes import open_episode
from surrogym_sampler.original.lags import begun, followed
from surrogym_sampler.original.loading import make
from surrogym_shared.network import Layer, Network
from surrogym_shared.spec import DiscreteAction, EnvironmentSpec
from surrogym_shared.terms import observe as declared
from surrogym_trainer.deployment.c import write
from surrogym_trainer.deployment.c.files import prefix_of, running, sensors_of
from surrogym_trainer.deployment.controller import Array, Choices, Controller
from surrogym_trainer.deployment.graph import write as write_onnx
from surrogym_trainer.deployment.reading import controller_of
from surrogym_trainer.deployment.reference import Decided, begin, decide, observe, scores
from surrogym_trainer.deployment.running import Comparison
from surrogym_trainer.policies import load_policy
from surrogym_trainer.policies.card import PolicyCard, write_card

HISTORY = {"changes": 2, "actions": 2, "largest": {"angle": 0.5, "slide": 0.2}, "at_start": {"angle": 0.3}}
BULK = """
#include "{p}_controller.h"
void bulk(long n, const {p}_real *m, const {p}_real *age, {p}_real *action, int *status)
{{
    {p}_controller c;
    long i;
    for (i = 0; i < n; i++) {{
        {p}_reset(&c);
        status[i] = {p}_step(&c, m + i * {P}_MEASUREMENTS, age[i], action + i * {P}_ACTIONS);
    }}
}}
"""
TINY = """
#include "{p}_controller.h"
static {p}_controller c;
volatile {p}_real m[{P}_MEASUREMENTS], a[{P}_ACTIONS];
int main(void)
{{
    {p}_real in[{P}_MEASUREMENTS], out[{P}_ACTIONS];
    int i;
    {p}_reset(&c);
    for (;;) {{
        for (i = 0; i < {P}_MEASUREMENTS; i++)
            in[i] = m[i];
        {p}_step(&c, in, 0, out);
        for (i = 0; i < {P}_ACTIONS; i++)
            a[i] = out[i];
    }}
}}
"""
ROWS = 50_000  # states at once in the reference
LOOP = 100  # steps of a closed loop
M4 = ("-mcpu=cortex-m4", "-mthumb", "-mfloat-abi=hard", "-mfpu=fpv4-sp-d16", "-Os", "-ffunction-sections")


def cases(folder: Path) -> dict[str, Controller]:
    """Controllers of every form, by name."""
    made = {}
    for name, spec, units, fallback in [
        ("default network, history", plant(**HISTORY), (64, 64), None),
        ("linear", plant(), 0, None),
        ("discrete", plant(DiscreteAction(n=3)), (64, 64), (0.0,)),
    ]:
        made[name] = controller_of(network(folder, spec, units), choices=Choices(fallback=fallback))
    for name in ("PPO, standardised", "SAC", "DQN"):
        spec = plant(LEARNERS[name][2])
        choices = Choices(fallback=(0.0,) if spec.action.kind == "discrete" else None)
        made[f"Stable-Baselines3 {name}"] = controller_of(learner(folder, name, spec), trust=True, choices=choices)
    return made


def in_type(controller: Controller, real: type) -> Controller:
    """The controller whose sensors have ends that the type of numbers has, so that edges can be compared."""
    rounded = (
        replace(m, lowest=float(real(m.lowest)), highest=float(real(m.highest))) for m in controller.measurements
    )
    return replace(controller, measurements=tuple(rounded))


def states(controller: Controller, count: int, real: type) -> tuple[np.ndarray, np.ndarray]:
    """Measurements (n, R) over the range and beyond, with edges, NaN and infinities, and their ages (n,)."""
    rng = np.random.default_rng(0)
    low, high = (end.astype(real) for end in sensors_of(controller))
    narrow = np.minimum(high, 10.0), np.maximum(low, -10.0)  # angles of a few turns
    reads = rng.uniform(narrow[1], narrow[0], (count, len(low))).astype(real)
    age = np.zeros(count, dtype=real)
    tiny = float(np.finfo(real).smallest_subnormal)
    for k, value in enumerate((np.nan, np.inf, -np.inf, float(np.finfo(real).max), -0.0, tiny)):
        reads[k::601, rng.integers(len(low))] = value
    reads[7::601], reads[8::601] = low, high
    reads[9::601], reads[10::601] = np.nextafter(low, real(-np.inf)), np.nextafter(high, real(np.inf))
    age[11::601], age[12::601], age[13::601] = np.nan, np.inf, -1.0
    return reads, age


def equal(folder: Path, options: Any) -> None:
    for name, controller in cases(folder).items():
        for single in (False, True):
            real = np.float32 if single else np.float64
            controller = in_type(controller, real)
            shown, ages = states(controller, options.random, real)
            expected = referred(controller, shown.astype(np.float64), ages.astype(np.float64))
            action, status = bulk(controller, folder / f"{len(list(folder.iterdir()))}", shown, ages, single=single)
            differs = status != expected.status
            largest, other = differences(controller, action, expected.action, shown)
            print(f"{name}, {'float' if single else 'double'}: {len(shown)} random states, ", end="")
            print(f"{int((status > 0).sum())} faults, {int(differs.sum())} other statuses, ", end="")
            print(f"largest difference {largest:.2g} of the range{other}")
    for single in (False, True):
        visited(folder, options.visited, single=single)


def referred(controller: Controller, reads: Array, age: Array) -> Decided:
    """What the reference decides, some rows at a time: all of them together fill the memory."""
    parts = [
        decide(controller, begin(controller, len(some)), some, age[at : at + ROWS])
        for at in range(0, len(reads), ROWS)
        if len(some := reads[at : at + ROWS])
    ]
    action, status = (np.concatenate([getattr(part, name) for part in parts]) for name in ("action", "status"))
    return Decided(parts[0].memory, action, status)


def differences(controller: Controller, action: Array, expected: Array, reads: np.ndarray) -> tuple[float, str]:
    """Return the largest difference as a share of the range, and what else must be said. A choice of which the best two
    scores are equal up to rounding is counted apart."""
    share = (np.abs(action - expected) / (controller.high - controller.low)).max(1)
    if not controller.counts:
        return float(share.max()), ""
    used = len(np.unique(expected))
    other = np.flatnonzero(share > 0)
    q = decide(controller, begin(controller, len(other)), reads[other].astype(np.float64)).memory.coordinates
    y = np.sort(scores(controller.decision, observe(controller, q)), axis=1)
    margin = float((y[:, -1] - y[:, -2]).max()) if len(other) else 0.0
    return (
        0.0,
        f", {used} values of an action, {len(other)} other choices, their best two scores at most {margin:.2g} apart",
    )


def bulk(
    controller: Controller, folder: Path, reads: np.ndarray, age: np.ndarray, *, single: bool
) -> tuple[np.ndarray, np.ndarray]:
    folder.mkdir()
    write(controller, folder)
    p = prefix_of(controller)
    (folder / "bulk.c").write_text(BULK.format(p=p, P=p.upper()))
    flags = ["-shared", "-fPIC", *([f"-D{p.upper()}_FLOAT"] if single else [])]
    library = folder / "bulk.so"
    subprocess.run(
        ["cc", *STRICT, *flags, folder / f"{p}_controller.c", folder / "bulk.c", "-lm", "-o", library], check=True
    )
    action = np.zeros((len(reads), len(controller.low)), dtype=reads.dtype)
    status = np.zeros(len(reads), dtype=np.int32)
    pointers = [ctypes.c_void_p(array.ctypes.data) for array in (np.ascontiguousarray(reads), age, action, status)]
    ctypes.CDLL(str(library)).bulk(ctypes.c_long(len(reads)), *pointers)
    return action.astype(np.float64), status


def visited(folder: Path, count: int, *, single: bool) -> None:
    """Closed loops of a plant with lags, compared afterwards, all states at once: in double, lags are equal, and
    observations to 2 units in the last place."""
    spec = plant(**HISTORY)
    path = network(folder, spec)
    controller, policy = controller_of(path), load_policy(path)
    compiled = Compiled(controller, folder / f"visited{single}", single=single)
    rng, size = np.random.default_rng(1), (count, len(spec.coordinates))
    lags, kept, shown = np.empty(size), np.empty(size), np.empty((count, len(spec.observation)), np.float32)
    actions = np.empty((count, len(controller.low)))
    for step in range(count):
        if step % LOOP == 0:
            state, last = rng.uniform([-3, -1, 0], [3, 2, 1]), None
            compiled.reset()
        lags[step] = begun(spec, state) if last is None else followed(spec, lags[step - 1], last, state)
        _, actions[step] = compiled.step(state)
        kept[step], shown[step] = compiled.coordinates, compiled.observed()
        last = actions[step].astype(np.float32).astype(np.float64)
        state = state + np.array([0.3 * last[0] + rng.normal(0, 0.1), 0.05 * (last[1] - 5), 0.0])
        state[1] = np.clip(state[1], -1.2, 2.2)
    meant = declared(spec, lags).astype(np.float32)
    expected = decode_actions(spec, policy(meant), count)
    largest = (np.abs(actions - expected) / (controller.high - controller.low)).max()
    off = np.abs(kept - lags).max()
    print(f"visited, {'float' if single else 'double'}: {count} states, lags differ by at most {off:.2g}", end="")
    # In float, a change is the difference of two rounded numbers: its error is that of the numbers, not its own.
    apart = np.abs(shown.astype(np.float64) - meant)
    print(f", observations by at most {apart.max():.2g}, and in units in the last place of float32:", end="")
    for entry, column in zip(spec.observation, (apart / np.spacing(np.abs(meant))).T, strict=True):
        print(f" {entry.name} {column.max():.0f},", end="")
    print(f" actions from the policy's by {largest:.2g} of their range")


def strict(folder: Path, options: Any) -> None:
    for name, controller in cases(folder).items():
        made = folder / name.replace(" ", "-").replace(",", "")
        made.mkdir()
        write(controller, made)
        p = prefix_of(controller)
        for compiler in ("gcc", "clang"):
            if shutil.which(compiler) is None:
                print(f"{compiler} is not on this machine")
                continue
            for flags in ((), (f"-D{p.upper()}_FLOAT",)):
                sources = sorted(made.glob(f"{p}_*.c"))
                program = made / "vectors"
                subprocess.run([compiler, *STRICT, *SANITIZED, *flags, *sources, "-lm", "-o", program], check=True)
                out = subprocess.run([program], capture_output=True, text=True, check=True).stdout.strip()
                print(f"{name}, {compiler} {' '.join(flags)}: {out} under address and undefined")
        subprocess.run(
            ["gcc", *STRICT, "-fstack-usage", "-fcallgraph-info=su", "-c", made / f"{p}_controller.c"],
            check=True,
            cwd=made,
        )
        graph, usage = calls(made / f"{p}_controller.ci"), (made / f"{p}_controller.su").read_text().splitlines()
        largest = sum(int(line.split("\t")[1]) for line in usage)
        print(
            f"{name}: needs {', '.join(sorted(called_by_name(made / f'{p}_controller.o')))}; "
            f"recursive: {', '.join(recursive(graph)) or 'none'}; stack of all functions together {largest} bytes, "
            f"{'all' if all(line.endswith('static') for line in usage) else 'NOT all'} static"
        )


def timed(call: Callable[[], Any], calls: int = 2_000) -> float:
    """Median of 15 rounds, microseconds a call."""
    rounds = []
    for _ in range(15):
        begun_at = time.perf_counter()
        for _ in range(calls):
            call()
        rounds.append((time.perf_counter() - begun_at) / calls)
    return 1e6 * float(np.median(rounds))


def times(folder: Path, options: Any) -> None:
    import onnxruntime
    import torch

    from surrogym_trainer.policies.export import ArrayNetwork

    path = network(folder, plant())
    controller, policy = controller_of(path), Network.load(path)
    made = folder / "time"
    made.mkdir()
    write(controller, made)
    for compiler in ("gcc", "clang"):
        if shutil.which(compiler) is None:
            continue
        for flags in (
            ["-O2"],
            ["-O2", "-DARM_FLOAT"],
            ["-O3", "-march=native"],
            ["-O3", "-march=native", "-DARM_FLOAT"],
        ):
            command = [compiler, "-std=c99", *flags, *sorted(made.glob("*.c")), "-lm", "-o", made / "t"]
            subprocess.run(command, check=True)
            runs = [
                float(subprocess.run([made / "t", "time"], capture_output=True, text=True, check=True).stdout)
                for _ in range(5)
            ]
            print(f"C, {compiler} {' '.join(flags)}: {np.median(runs) / 1000:.2f} µs, measurements to action")
    row = np.random.default_rng(0).normal(size=(1, 4)).astype(np.float32)
    write_onnx(controller, folder)
    settings = onnxruntime.SessionOptions()
    settings.intra_op_num_threads = settings.inter_op_num_threads = 1
    session = onnxruntime.InferenceSession(folder / "arm.onnx", settings, providers=["CPUExecutionProvider"])
    onnx = timed(lambda: session.run(None, {"observation": row}))
    print(f"onnxruntime, one thread: {onnx:.2f} µs, observation to action")
    torch.set_num_threads(1)
    module, tensor = ArrayNetwork(policy).eval(), torch.as_tensor(row)
    with torch.inference_mode():
        print(f"torch, one thread: {timed(lambda: module(tensor)):.2f} µs, observation to action")
    print(f"NumPy, Network: {timed(lambda: policy(row)):.2f} µs, observation to action")


def arm(folder: Path, options: Any) -> None:
    for name, controller in cases(folder).items():
        made = folder / name.replace(" ", "-").replace(",", "")
        made.mkdir()
        write(controller, made)
        p = prefix_of(controller)
        single = f"-D{p.upper()}_FLOAT"
        if shutil.which("arm-linux-gnueabihf-gcc") and shutil.which("qemu-arm"):
            for flags in ([], [single]):
                program = made / "armhf"
                sources = sorted(made.glob(f"{p}_*.c"))
                command = ["arm-linux-gnueabihf-gcc", *STRICT, "-static", *flags, *sources, "-lm", "-o", program]
                subprocess.run(command, check=True)
                out = subprocess.run(["qemu-arm", program], capture_output=True, text=True, check=True).stdout
                print(f"{name}, armhf under qemu-arm {' '.join(flags)}: {out.strip()}")
        else:
            print("arm-linux-gnueabihf-gcc or qemu-arm is not on this machine")
        if shutil.which("arm-none-eabi-gcc") is None:
            print("arm-none-eabi-gcc is not on this machine")
            continue
        (made / "tiny.c").write_text(TINY.format(p=p, P=p.upper()))
        common = ["arm-none-eabi-gcc", "-std=c99", "-Wall", "-Wextra", "-Werror", *M4, single, "-fstack-usage"]
        for source in (f"{p}_controller.c", "tiny.c"):
            subprocess.run([*common, "-c", source], check=True, cwd=made)
        link = [
            *common,
            f"{p}_controller.o",
            "tiny.o",
            "--specs=nosys.specs",
            "-Wl,--gc-sections",
            "-lm",
            "-o",
            "tiny.elf",
        ]
        subprocess.run(link, check=True, cwd=made, stderr=subprocess.DEVNULL)
        own, whole = (size(made / file) for file in (f"{p}_controller.o", "tiny.elf"))
        usage = [line.split("\t") for line in (made / f"{p}_controller.su").read_text().splitlines()]
        deepest = {function.rsplit(":", 1)[1]: int(used) for function, used, _ in usage}
        print(
            f"{name}, Cortex-M4, float: flash {own[0]} bytes, {whole[0]} with the C library's start and mathematics; "
            f"RAM {own[1]} static and one controller; stack of {json.dumps(deepest)}"
        )


def size(file: Path) -> tuple[int, int]:
    """Flash and RAM of an object file, in bytes: text and data, data and bss."""
    out = subprocess.run(["arm-none-eabi-size", file], capture_output=True, text=True, check=True).stdout
    text, data, bss = map(int, out.splitlines()[1].split()[:3])
    return text + data, data + bss


def returns(folder: Path, options: Any) -> None:
    from dead_time import Vessel

    spec = Vessel().spec()
    compared("vessel with a dead time, random network", network(folder, spec, (32,), 0.5), Vessel, spec, options)
    car = make("MountainCarContinuous-v0").spec()
    path = folder / "car.zip"
    swing(car).save(path)  # pushes the way it moves: reaches the goal, and hits the stop on the way
    write_card(path, PolicyCard(surrogate="car", spec=car))
    compared(
        "MountainCarContinuous with its stops, linear", path, lambda: make("MountainCarContinuous-v0"), car, options
    )
    if options.policy:
        own = make(options.env).spec()
        compared(f"{options.env}, {options.policy}", Path(options.policy), lambda: make(options.env), own, options)


def swing(spec: EnvironmentSpec) -> Network:
    """A linear policy of MountainCarContinuous: the action is tanh(100 speed)."""
    weights = np.zeros((len(spec.observation), 1))
    weights[spec.observation_names.index("velocity")] = 100.0
    d = len(spec.observation)
    return Network(np.zeros(d), np.ones(d), (Layer(weights, np.zeros(1)),), np.array([-1.0]), np.array([1.0]))


def compared(name: str, path: Path, factory: Callable[[], Any], spec: EnvironmentSpec, options: Any) -> None:
    controller = controller_of(path, spec)
    episode = open_episode(spec.environment, spec, factory)
    with running(controller) as compiled:
        comparison = Comparison(controller, compiled, load_policy(path), episode)
        checked = comparison.over(range(10_000, 10_000 + options.episodes), [].append)
    difference = np.abs(checked.returns - checked.policy_returns).max()
    print(f"{name}: {len(checked.returns)} episodes, {checked.steps} steps, {checked.faults} faults")
    print(f"  mean return {checked.returns.mean():.6f} from C, {checked.policy_returns.mean():.6f} from Python")
    print(f"  largest difference of a return {difference:.2g}, of an action {checked.largest:.2g} of its range")


PARTS = {"equal": equal, "strict": strict, "time": times, "arm": arm, "returns": returns}


def main() -> None:
    read = parser(__doc__)
    read.add_argument("parts", nargs="*", help=f"{', '.join(PARTS)}; all without one")
    read.add_argument("--random", type=int, default=1_000_000, help="random states of each controller")
    read.add_argument("--visited", type=int, default=100_000, help="visited states")
    read.add_argument("--episodes", type=int, default=100)
    read.add_argument("--policy", help="file of a trained policy, with its card")
    read.add_argument("--env", help="its original environment")
    options = started(read)
    sys.path.insert(0, str(Path.cwd()))
    for part in options.parts or PARTS:
        with TemporaryDirectory() as folder:
            PARTS[part](Path(folder), options)


if __name__ == "__main__":
    main()
