"""The conformance suite of programs: one that keeps the protocol passes, and a broken promise fails its check alone."""

from __future__ import annotations

import json
import shlex
from pathlib import Path

import pytest
from typer.testing import CliRunner

from support.programs import FALLS_BACK, KEEPS_LIMITS, program
from surrogym.cli import build
from surrogym_sampler.diagnosis.executables import FIRST, conformance

SHELL = Path(__file__).parents[2] / "examples" / "executables" / "rail.sh"
SEEDED = 'random.Random(request["seed"]).uniform(-0.5, 0.5)'
FALLS = "without input the fallback of limits acts"
SAME = "a program that was started anew is the same"


def failures(command: str, seconds: float = 10.0) -> dict[str, str]:
    return {outcome.name: outcome.failure for outcome in conformance(command, seconds) if outcome.failure}


@pytest.mark.parametrize(
    ("before", "after", "broken"),
    [
        ('"protocol": 1', '"protocol": request["protocol"]', {"a newer protocol is not accepted"}),
        ('"code": "unsupported"', '"code": "unknown"', {"an unknown method is unsupported"}),
        ("except (ValueError, ", "except (", {"a line that is no request gets an error"}),
        ('[u] = request["action"]', '[u] = request.get("action", [0.0])', {"a step without an action gets an error"}),
        (SEEDED, "random.uniform(-0.5, 0.5)", {"a seed repeats its start", SAME}),
        (SEEDED, "0.25", {"other seeds give other starts"}),
        ("return go(to)", "return go(float(int(to)))", {"set reaches the state"}),
        (
            'return {"state": [x]}\n\ndef save',
            'return {"state": [0]}\n\ndef save',
            {"get gives the state that was set"},
        ),
        (
            "x + 0.1 * u",
            "x + 0.1 * u + 0.05 * last",
            {"a step depends on nothing but state and action", "restore returns to what was saved"},
        ),
        ('float(request["snapshot"])', "0.0", {"restore returns to what was saved"}),
        ('    if method == "close":\n        break', "", {"close ends the program"}),
        (
            "        break\n",
            "        os._exit(3)\ntime.sleep(3600)\n",
            {"the end of its input ends the program", "close ends the program"},
        ),
    ],
)
def test_a_program_that_breaks_a_protocol_rule_fails_only_that_check(
    tmp_path: Path, before: str, after: str, broken: set[str]
):
    assert failures(program(tmp_path, (before, after))).keys() == broken


def test_a_program_that_does_not_repeat_the_request_number_fails(tmp_path: Path):
    number = ('number, method = request["id"]', "number, method = 1")
    assert "an answer repeats the number of its request" in failures(program(tmp_path, number))


def test_the_check_of_a_program_names_a_missing_field_and_its_remedy(tmp_path: Path):
    said = failures(program(tmp_path, ('"truncated": False', '"time": 0')))["a step gives state reward and ends"]
    assert "expected true or false for 'truncated'" in said
    assert said.endswith("give all four fields in every answer to step")
    assert "surrogym conformance" not in said, "the command does not advise to run itself"


def test_program_check_errors_name_fields_without_python_terms(tmp_path: Path):
    one_start = failures(program(tmp_path, (SEEDED, "0.25")))["other seeds give other starts"]
    assert "got [0.25] each time" in one_start
    no_snapshot = failures(program(tmp_path, ('{"snapshot": ', '{"state": ')))["restore returns to what was saved"]
    assert "expected a text for 'snapshot' in the program's answer, got nothing" in no_snapshot


def test_a_program_that_applies_its_safe_action_when_its_input_ends_passes_every_check(tmp_path: Path):
    checked = list(conformance(program(tmp_path, KEEPS_LIMITS, FALLS_BACK), 10.0))
    assert {outcome.name: outcome.failure for outcome in checked if outcome.failure} == {}
    assert FALLS in {outcome.name for outcome in checked if outcome.left_out is None}


@pytest.mark.parametrize(
    ("before", "after", "said"),
    [
        (
            "    print(json.dumps({'fallback': steps}), flush=True)",
            "    pass",
            "got none from a program that ended with",
        ),
        ("    steps, before = 0, None", "    time.sleep(3600)", "got none from a program that still ran after 4 s"),
        ("json.dumps({'fallback': steps})", "'done'", "with 1 to 200 steps, got done;"),
        ("{'fallback': steps}", "{'fallback': 0}", 'got {"fallback": 0};'),
        (
            "{'fallback': steps}), flush=True)",
            "{'fallback': steps}), flush=True)\n    time.sleep(3600)",
            "after this line",
        ),
    ],
)
def test_a_program_with_limits_that_does_not_report_its_fallback_fails_that_check(
    tmp_path: Path, before: str, after: str, said: str
):
    faulty = (FALLS_BACK[0], FALLS_BACK[1].replace('"', "'").replace(before, after))
    assert faulty[1] != FALLS_BACK[1].replace('"', "'")
    failed = failures(program(tmp_path, KEEPS_LIMITS, faulty), 3.0 if "ran" in said else 10.0)
    assert said in failed.pop(FALLS)
    assert failed.keys() <= {"the end of its input ends the program"}


def test_a_program_with_limits_that_only_ends_is_told_what_to_do(tmp_path: Path):
    said = failures(program(tmp_path, KEEPS_LIMITS))
    assert said.keys() == {FALLS}
    assert said[FALLS].startswith(
        'expected a line such as {"fallback": 12}, got none from a program that ended with exit'
    )
    assert "apply the fallback of its limits until the machine rests, then print this line" in said[FALLS]


def test_a_program_that_supports_only_rollouts_need_not_support_set(tmp_path: Path):
    command = program(tmp_path, ('"query":"step"', '"query":"rollout"'), ('"set": put, "get": get, ', ""))
    left_out = {outcome.name for outcome in conformance(command, 10.0) if outcome.left_out}
    assert failures(command) == {}
    assert left_out == {
        "set reaches the state",
        "get gives the state that was set",
        "a step depends on nothing but state and action",
        FALLS,
    }


@pytest.mark.parametrize(
    ("command", "reason"),
    [
        ("./no-such-plant", "can be started"),
        ("sh -c 'exit 3'", "exit code 3"),
        ("echo hello", "hello"),
    ],
)
def test_the_check_of_a_program_without_specification_stops_early(command: str, reason: str):
    [outcome] = conformance(command, 10.0)
    assert outcome.name == FIRST
    assert outcome.failure is not None
    assert reason in outcome.failure


def test_the_program_check_command_lists_each_check_and_its_exit_code_tells_failure(tmp_path: Path):
    def run(*options: str):
        return CliRunner().invoke(build(), ["conformance", *options])

    passed = run("--exec", f"sh {shlex.quote(str(SHELL))}")
    failed = run("--exec", program(tmp_path, (SEEDED, "0.25")), "--json")
    assert (passed.exit_code, failed.exit_code) == (0, 1)
    assert passed.stdout.endswith("17 of 17 checks passed, 2 left out\n")
    assert json.loads(failed.stdout)["failed"].keys() == {"other seeds give other starts"}
