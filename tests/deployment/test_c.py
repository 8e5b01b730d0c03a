"""A controller in C decides as its policy does, with nothing but a stack, and says so when a measurement is wrong."""

from __future__ import annotations

import hashlib
import json
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from support.compilers import NEEDS_C, SANITIZED, Compiled, called_by_name, calls, compile_c, recursive, run
from support.controllers import LEARNERS, holding, learner, limited, network, plant
from surrogym_sampler.original.actions import decode_actions
from surrogym_sampler.original.lags import begun, followed
from surrogym_sampler.original.limits import Guard
from surrogym_shared.spec import DiscreteAction, MultiDiscreteAction
from surrogym_shared.terms import observe as declared
from surrogym_trainer.deployment.c import write, write_arduino
from surrogym_trainer.deployment.c.files import sensors_of, vectors_of
from surrogym_trainer.deployment.controller import LIMITED, Choices, Controller, NotDeployable
from surrogym_trainer.deployment.reading import controller_of
from surrogym_trainer.deployment.reference import begin, decide
from surrogym_trainer.deployment.targets import deploy
from surrogym_trainer.policies import load_policy

pytestmark = NEEDS_C
HISTORY = {"changes": 2, "actions": 2, "largest": {"angle": 0.5, "slide": 0.2}, "at_start": {"angle": 0.3}}
ALLOWED = {"sin", "cos", "exp", "fmod", "memcpy", "memset"}
PLANTS = {
    "history": (plant(**HISTORY), (64, 64), None),
    "linear": (plant(), 0, None),
    "limits": (limited(plant(**HISTORY)), (16,), None),
    "rates": (limited(plant(**HISTORY, rate=(20.0, None))), (16,), None),
    "integral": (holding(plant(**HISTORY)), (16,), None),
    "choices": (plant(MultiDiscreteAction(nvec=(2, 5)), actions=1), (16,), (1.0, 3.0)),
}


def made(folder: Path, case: str) -> Controller:
    spec, units, fallback = PLANTS[case]
    settings = {"integral": ("slide",)} if case == "integral" else {}
    return controller_of(network(folder, spec, units, settings=settings), choices=Choices(fallback=fallback))


@pytest.mark.parametrize("flags", [(), ("-DARM_FLOAT",)], ids=["double", "float"])
@pytest.mark.parametrize("compiler", ["gcc", "clang"])
@pytest.mark.parametrize("case", PLANTS)
def test_the_test_vectors_of_a_c_controller_pass_under_sanitizers(tmp_path: Path, case: str, compiler: str, flags):
    if shutil.which(compiler) is None:
        pytest.skip(f"{compiler} is not on this machine")
    folder = tmp_path / "c"
    folder.mkdir()
    write(made(tmp_path, case), folder)
    program = compile_c(compiler, sorted(folder.glob("*.c")), tmp_path / "vectors", *SANITIZED, *flags)
    assert re.fullmatch(r"(\d+) of \1 vectors passed\n", run(program))


@pytest.mark.skipif(shutil.which("size") is None, reason="size is not on this machine")
def test_the_c_test_program_fits_into_microcontroller_memory(tmp_path: Path):
    (tmp_path / "c").mkdir()
    write(made(tmp_path, "history"), tmp_path / "c")
    out = tmp_path / "main.o"
    compile_c("cc", [tmp_path / "c" / "arm_main.c"], out, "-c")
    said = subprocess.run(["size", out], capture_output=True, text=True, check=True).stdout
    data, bss = map(int, said.splitlines()[1].split()[1:3])
    assert data + bss <= 32_768, "a board of 64 kB has more to hold than the vectors"


def test_a_c_controller_with_a_wrong_weight_fails_its_test_vectors(tmp_path: Path):
    folder = tmp_path / "c"
    folder.mkdir()
    write(made(tmp_path, "history"), folder)
    source = folder / "arm_controller.c"
    text = source.read_text()
    source.write_text(text.replace("a[i] = (observation[i] - MEAN[i])", "a[i] = (observation[i] + MEAN[i])"))
    assert source.read_text() != text
    program = compile_c("cc", sorted(folder.glob("*.c")), tmp_path / "vectors")
    assert subprocess.run([program], capture_output=True, check=False).returncode == 1


@pytest.mark.parametrize(
    "ranges",
    [{"angle": (3.14, 3.15)}, {"angle": (-1e37, 1e37)}, {"slide": (300.0, 300.001)}, {"slide": (0.0, 1e30)}],
    ids=str,
)
def test_c_test_vectors_pass_for_narrow_and_wide_sensor_ranges_in_both_precisions(tmp_path: Path, ranges):
    path = network(tmp_path, plant(**HISTORY), (8,))
    controller = controller_of(path, choices=Choices(ranges=ranges))
    assert sum(vector.status == 0 for vector in vectors_of(controller)) >= 40
    (tmp_path / "c").mkdir()
    write(controller, tmp_path / "c")
    for flags in ((), ("-DARM_FLOAT",)):
        run(compile_c("cc", sorted((tmp_path / "c").glob("*.c")), tmp_path / "vectors", *flags))


@pytest.mark.parametrize(("single", "tolerance"), [(False, 1e-6), (True, 1e-4)], ids=["double", "float"])
@pytest.mark.parametrize("case", PLANTS)
def test_a_c_controller_gives_the_reference_actions_for_random_measurements(
    tmp_path: Path, case: str, single: bool, tolerance
):
    controller = made(tmp_path, case)
    compiled, rng = Compiled(controller, tmp_path / "c", single=single), np.random.default_rng(1)
    low, high = sensors_of(controller)
    reads = rng.uniform(low, high, (500, len(low))).astype(np.float32).astype(np.float64)
    reads[::50, 0], reads[25::50, 1], reads[13::50] = np.nan, np.inf, high
    memory, close, chosen = begin(controller), [], []
    for read in reads:
        decided = decide(controller, memory, read[None])
        status, action = compiled.step(read)
        assert status == decided.status
        close.append((np.abs(action - decided.action[0]) <= tolerance * (controller.high - controller.low)).all())
        memory = decided.memory
        chosen.append(tuple(action))
    assert len(set(chosen)) >= 4, "a policy that always does the same shows nothing"
    # in float the two best choices may be equal up to rounding, and an angle may lie at half a turn
    assert np.mean(close) >= (0.98 if single else 1.0)


def test_test_vectors_and_random_measurements_trigger_the_limits_of_a_controller(tmp_path: Path):
    controller = made(tmp_path, "limits")
    assert sum(vector.status == LIMITED for vector in vectors_of(controller)) >= 3
    assert "ARM_LIMITED = 16" in header(controller, tmp_path)
    assert "LIMITED" not in header(made(tmp_path, "history"), tmp_path)


def test_a_controller_with_limits_applies_the_fallback_exactly_where_an_evaluation_does(tmp_path: Path):
    spec = limited(plant(**HISTORY))
    controller, guard, rng = controller_of(network(tmp_path, spec, (16,))), Guard(spec), np.random.default_rng(0)
    memory, fell = begin(controller), []
    low, high = np.array([-2.0, -1.0, 0.0]), np.array([2.0, 2.0, 1.0])
    reads = rng.uniform(low, high, (400, 3))
    for step, read in enumerate(reads):
        memory, (action,), (status,) = decide(controller, memory, read[None])
        coordinates = memory.coordinates[0]
        guard.begin(coordinates) if step == 0 else guard.reached(coordinates)
        chosen, fallen = guard.choose(action)
        assert fallen == (status == LIMITED)
        np.testing.assert_allclose(chosen, action, rtol=1e-12)
        fell.append(fallen)
    assert 20 < sum(fell) < 380


def header(controller: Controller, folder: Path) -> str:
    shutil.rmtree(folder / "header", ignore_errors=True)
    (folder / "header").mkdir()
    write(controller, folder / "header")
    return (folder / "header" / "arm_controller.h").read_text()


def test_a_c_controller_with_lagged_inputs_equals_its_policy_in_closed_loop(tmp_path: Path):
    spec = plant(**HISTORY)
    path = network(tmp_path, spec)
    compiled, policy = Compiled(controller_of(path), tmp_path / "c"), load_policy(path)
    rng, state, q, last = np.random.default_rng(0), np.array([3.0, 0.5, 0.2]), None, None
    for _ in range(300):
        q = begun(spec, state) if q is None else followed(spec, q, last, state)
        status, action = compiled.step(state)
        assert status == 0
        np.testing.assert_array_equal(compiled.coordinates, q)
        shown = declared(spec, q[None]).astype(np.float32)
        np.testing.assert_array_max_ulp(compiled.observed().astype(np.float32), shown[0], maxulp=2)
        np.testing.assert_allclose(action, decode_actions(spec, policy(shown), 1)[0], atol=1e-5)
        last = action.astype(np.float32).astype(np.float64)
        state += [0.3 * last[0] + rng.normal(0, 0.1), 0.05 * (last[1] - 5), 0.0]
        state[1] = np.clip(state[1], -1.2, 2.2)


@pytest.mark.parametrize("case", ["SAC", "DQN", "PPO, bins"])
def test_stable_baselines3_policies_run_in_c(tmp_path: Path, case: str):
    spec = plant(LEARNERS[case][2])
    fallback = (0.0,) if spec.action.kind == "discrete" else None
    path = learner(tmp_path, case, spec)
    compiled = Compiled(controller_of(path, trust=True, choices=Choices(fallback=fallback)), tmp_path / "c")
    policy, chosen = load_policy(path, LEARNERS[case][0], trust=True), set()
    for read in np.random.default_rng(0).uniform([-3, -1, 0], [3, 2, 1], (100, 3)):
        shown = declared(spec, begun(spec, read)[None]).astype(np.float32)
        action = compiled.step(read)[1]
        np.testing.assert_allclose(action, decode_actions(spec, policy(shown), 1)[0], atol=1e-3)
        chosen.add(tuple(action))
    assert len(chosen) > 1, "a policy that always does the same shows nothing"


@pytest.mark.parametrize("case", PLANTS)
def test_the_generated_c_source_uses_no_heap_no_recursion_and_little_stack(tmp_path: Path, case: str):
    if shutil.which("gcc") is None:
        pytest.skip("gcc is not on this machine")
    folder = tmp_path / "c"
    folder.mkdir()
    write(made(tmp_path, case), folder)
    out = folder / "controller.o"
    compile_c("gcc", [folder / "arm_controller.c"], out, "-c", "-fstack-usage", "-fcallgraph-info=su")
    assert called_by_name(out) <= ALLOWED
    graph = calls(next(folder.glob("*.ci")))
    assert recursive(graph) == set()
    assert recursive({"a": {"b"}, "b": {"c"}, "c": {"b"}}) == {"b", "c"}, "the look finds what it looks for"
    usage = [line.split("\t") for line in next(folder.glob("*.su")).read_text().splitlines()]
    assert {kind for _, _, kind in usage} == {"static"}
    stated = re.search(r"_STACK \((\d+) \* sizeof\(arm_real\) \+ 256\)", (folder / "arm_controller.h").read_text())
    assert sum(int(size) for _, size, _ in usage) <= int(stated.group(1)) * 8 + 256
    constants = re.findall(r"static const real \w+\[(\d+)\]", (folder / "arm_controller.c").read_text())
    assert f" and {sum(map(int, constants)):,} constants." in (folder / "arm_controller.h").read_text()


TWO = """
#include "arm_controller.h"
#include <cstdio>
int main() {
    arm_controller one, other;
    arm_real measured[2][3] = {{1, 0.5, 0.2}, {-2, 1.5, 0.9}}, actions[2][ARM_ACTIONS];
    arm_reset(&one);
    arm_reset(&other);
    for (int step = 0; step < 5; step++) {
        arm_step(&one, measured[0], 0, actions[0]);
        arm_step(&other, measured[1], 0, actions[1]);
        measured[0][0] += 0.1;
        measured[1][0] -= 0.2;
    }
    std::printf("%s %.17g %.17g\\n", ARM_POLICY_SHA256, actions[0][0], actions[1][0]);
}
"""


@pytest.mark.skipif(shutil.which("g++") is None, reason="g++ is not on this machine")
def test_a_cpp_program_can_run_two_generated_controllers(tmp_path: Path):
    path = network(tmp_path, plant(**HISTORY))
    controller = controller_of(path)
    (tmp_path / "c").mkdir()
    write(controller, tmp_path / "c")
    (tmp_path / "two.cpp").write_text(TWO)
    sources = [tmp_path / "two.cpp", "-x", "c", tmp_path / "c" / "arm_controller.c"]
    subprocess.run(["g++", f"-I{tmp_path / 'c'}", *sources, "-lm", "-o", tmp_path / "two"], check=True)
    digest, *actions = run(tmp_path / "two").split()
    assert digest == hashlib.sha256(path.read_bytes()).hexdigest()
    for action, read, turn in zip(actions, ([1, 0.5, 0.2], [-2, 1.5, 0.9]), (0.1, -0.2), strict=True):
        memory = begin(controller)
        for step in range(5):
            decided = decide(controller, memory, np.array([[read[0] + step * turn, *read[1:]]]))
            memory = decided.memory
        assert float(action) == pytest.approx(decided.action[0, 0], abs=1e-6)


def test_names_containing_comment_ends_do_not_break_the_generated_c_source(tmp_path: Path):
    spec = plant()
    text = spec.model_dump_json().replace('"slide"', r'"*/ int x; /* ??/\\"')
    path = network(tmp_path, type(spec).model_validate_json(text), model='*/ " ??/\n\\"')
    (tmp_path / "c").mkdir()
    write(controller_of(path), tmp_path / "c")
    run(compile_c("cc", sorted((tmp_path / "c").glob("*.c")), tmp_path / "vectors"))


def test_deploying_c_into_a_folder_with_other_files_is_refused(tmp_path: Path):
    controller = made(tmp_path, "linear")
    written = deploy(controller, "c", tmp_path / "out")
    assert deploy(controller, "c", tmp_path / "out") == written, "the same files again change nothing"
    (tmp_path / "out" / "arm_controller.c").write_text("mine")
    before = {path: path.read_bytes() for path in written}
    with pytest.raises(NotDeployable, match=r"arm_controller\.c: nothing was written"):
        deploy(controller, "c", tmp_path / "out")
    assert {path: path.read_bytes() for path in (tmp_path / "out").iterdir()} == before
    with pytest.raises(NotDeployable, match=r"expected one of the targets c, arduino, .*got 'plc'"):
        deploy(controller, "plc", tmp_path / "new")
    assert not (tmp_path / "new").exists()


def test_a_failed_c_deployment_leaves_no_files(tmp_path: Path):
    out = tmp_path / "out"
    out.mkdir()
    (out / "arm_main.c").symlink_to("/nonexistent/arm_main.c")  # written last
    with pytest.raises(OSError, match=r"arm_main\.c"):
        deploy(made(tmp_path, "linear"), "c", out)
    assert [path.name for path in out.iterdir()] == ["arm_main.c"]


def test_the_generated_arduino_library_is_complete_and_its_sketch_compiles(tmp_path: Path):
    controller = controller_of(network(tmp_path, plant(DiscreteAction(n=3))), choices=Choices(fallback=(0.0,)))
    folder = tmp_path / "library"
    folder.mkdir()
    write_arduino(controller, folder)
    assert json.loads((folder / "library.json").read_text())["headers"] == "arm_controller.h"
    properties = dict(line.split("=", 1) for line in (folder / "library.properties").read_text().splitlines())
    assert properties["includes"] == "arm_controller.h"
    assert "#define ARM_FLOAT\n" in (folder / "src" / "arm_controller.h").read_text(), "the sketch sees it as well"
    if shutil.which("g++") is None:
        pytest.skip("g++ is not on this machine")
    stub = tmp_path / "Arduino.h"
    stub.write_text("#include <stdint.h>\nunsigned long millis();\nunsigned long micros();\n")
    sketch = folder / "examples" / "control" / "control.ino"
    strict = ["-Wall", "-Wextra", "-Werror", "-include", stub, f"-I{folder / 'src'}"]
    subprocess.run(["g++", *strict, "-x", "c++", "-c", sketch, "-o", tmp_path / "sketch.o"], check=True)


SIMULATED = """
#include <stdint.h>
#include <stdio.h>
static uint32_t now = 4294000000u;
static bool fresh = false;
static int applied = 0;
unsigned long micros() { return now; }
#include "sketch.cpp"
static int decisions(uint32_t after) {
    int before = applied;
    now += after;
    for (int i = 0; i < 3; i++) loop();
    return applied - before;
}
int main() {
    setup();
    const uint32_t times[] = {0, 2499, 1, 100000};
    for (uint32_t after : times) printf("%d ", decisions(after));
    fresh = true;
    decisions(2500);
    fresh = false;
    printf("%d ", action[0] != 2);
    decisions(100000);
    printf("%d ", action[0] == 2);
    for (int third = 0; third < 3; third++) decisions(1431622432u); /* 2^32 us after the measurement */
    printf("%d\\n", action[0] == 2);
}
"""


@pytest.mark.skipif(shutil.which("g++") is None, reason="g++ is not on this machine")
def test_an_arduino_sketch_keeps_its_period_when_its_clock_wraps_around(tmp_path: Path):
    path, choices = (
        network(tmp_path, plant().model_copy(update={"sampling_period": 0.0025})),
        Choices(fallback=(2.0, 0.0)),
    )
    folder = tmp_path / "library"
    folder.mkdir()
    write_arduino(controller_of(path, choices=choices), folder)
    sketch = (folder / "examples" / "control" / "control.ino").read_text()
    sketch = sketch.replace("return false;", "return fresh;").replace("// Send action", "applied++; // Send action")
    (tmp_path / "sketch.cpp").write_text(sketch)
    (tmp_path / "main.cpp").write_text(SIMULATED)
    sources = [tmp_path / "main.cpp", "-x", "c", folder / "src" / "arm_controller.c"]
    subprocess.run(["g++", f"-I{folder / 'src'}", *sources, "-lm", "-o", tmp_path / "main"], check=True)
    assert run(tmp_path / "main").split() == ["1", "0", "1", "1", "1", "1", "1"]


def test_an_arduino_sketch_with_a_period_its_clock_cannot_count_is_refused(tmp_path: Path):
    path = network(tmp_path, plant().model_copy(update={"sampling_period": 3e6}))
    with pytest.raises(NotDeployable, match="at most 2,000,000 s for a sketch, got 6e"):
        write_arduino(controller_of(path), tmp_path)
