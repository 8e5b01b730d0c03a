"""What is not in place is found, and said with the way out of it."""

from __future__ import annotations

import pytest

from support.programs import HANGS, NOTES_ITSELF, UNTERMINABLE, left_behind, program
from support.scripted_server import problem, reply, scripted_server
from surrogym_client.runtime.versions import EXTRAS
from surrogym_shared import wire
from surrogym_shared.codes import Code

BROKEN = """
from surrogym_sampler.original.classic import pendulum
from surrogym_sampler.original import RealStep

class Pendulum:
    def spec(self):
        return pendulum().model_copy(update={"environment": "broken:Pendulum"})

    def step_from(self, coordinates, action):
        return RealStep(coordinates, action, coordinates[:1], 0.0)

    def close(self):
        pass
"""
EVERYTHING = {"python", "packages", "server", "ready", "token", "round trip", "environment", "step"} | {
    *("state", "resets", "memory", "snapshots", "mode")
}


def lines(said) -> dict[str, tuple[str, str]]:
    """Verdict and words of each finding."""
    return {line[9:20].strip(): (line[:7].strip(), line[22:]) for line in said.out.splitlines()}


def found(said) -> dict[str, dict[str, str | None]]:
    return {finding["name"]: finding for finding in said.json["findings"]}


def test_the_doctor_command_reports_no_problem_if_everything_is_in_place(on_server):
    said = on_server("doctor", "--env", "Pendulum-v1")
    assert said.code == 0, said.out
    assert set(lines(said)) == EVERYTHING
    assert {verdict for verdict, _ in lines(said).values()} == {"ok"}
    assert f"protocol {wire.PROTOCOL}" in lines(said)["server"][1]
    assert "coordinates (theta, speed)" in lines(said)["environment"][1]
    assert lines(said)["mode"][1].startswith("set any state; this took ")
    assert on_server("doctor", "--quiet").out == ""


def test_the_doctor_command_says_after_how_many_checks_it_was_interrupted(on_server, monkeypatch):
    def stopped(_):
        raise KeyboardInterrupt

    monkeypatch.setattr("surrogym_sampler.diagnosis.doctor.service", stopped)
    ended = on_server("doctor")
    assert ended.code == 130
    assert ended.err == "interrupted after 2 checks; no command counts their real steps\n"


def test_the_doctor_command_without_a_server_reports_it_and_recommends_serve(surrogym):
    said = surrogym("doctor", "--server", "http://127.0.0.1:9", "--json")
    assert said.code == 1
    assert said.json["problems"] == 1
    assert set(found(said)) == {"python", "packages", "server"}
    assert "surrogym serve" in found(said)["server"]["way_out"]


def test_the_doctor_command_reports_a_server_with_another_protocol_version(surrogym):
    newer = wire.Health(version="9", protocol=wire.PROTOCOL + 1)
    with scripted_server(reply(newer.model_dump_json())) as server:
        said = surrogym("doctor", "--server", server.url)
    assert said.code == 1
    assert lines(said)["server"][0] == "problem"
    assert f"got {wire.PROTOCOL + 1}" in lines(said)["server"][1]


@pytest.mark.parametrize(
    ("ready", "access", "broken", "way_out"),
    [
        (problem(Code.UNAVAILABLE), reply('{"role": "read", "tokens": true}'), "ready", "database"),
        (reply('{"status": "ready", "storage": "ok"}'), problem(Code.UNAUTHENTICATED), "token", "SURROGYM_TOKEN"),
    ],
)
def test_the_doctor_command_continues_its_checks_after_a_problem(surrogym, monkeypatch, ready, access, broken, way_out):
    monkeypatch.setattr("surrogym.cli.options.QUICK", 0.0)
    alive = reply(wire.Health(version="0.1.0").model_dump_json())
    with scripted_server(alive, ready, access, alive) as server:
        said = surrogym("doctor", "--server", server.url)
    assert said.code == 1
    assert [name for name, (verdict, _) in lines(said).items() if verdict == "problem"] == [broken]
    assert way_out in lines(said)[broken][1]


def test_the_doctor_command_reports_the_role_of_the_token(surrogym):
    alive = reply(wire.Health(version="0.1.0").model_dump_json())
    access = reply(wire.Access(role="sample", tokens=True).model_dump_json())
    with scripted_server(alive, reply('{"status": "ready", "storage": "ok"}'), access, alive) as server:
        said = surrogym("doctor", "--server", server.url)
    assert lines(said)["token"] == ("ok", "role sample")


def test_the_doctor_command_reports_an_environment_that_cannot_be_created_or_stepped(on_server, tmp_path):
    (tmp_path / "broken.py").write_text(BROKEN)
    said = on_server("doctor", "--env", "broken:Pendulum", "--quiet")
    assert said.code == 1
    assert list(lines(said)) == ["step"]
    assert "expected the shape (2,) for next_coordinates of a real step, got (1,)" in lines(said)["step"][1]
    missing = on_server("doctor", "--env", "Nowhere-v1", "--quiet")
    assert "Nowhere-v1 can't be made: Environment `Nowhere` doesn't exist" in lines(missing)["environment"][1]


def test_the_doctor_command_names_a_missing_optional_dependency(on_server, monkeypatch):
    monkeypatch.setitem(EXTRAS, "rare", ("no_such_module",))
    _, _, lacking = lines(on_server("doctor"))["packages"][1].partition("not installed: ")
    assert "surrogym[rare]" in lacking


def test_the_doctor_command_ends_an_environment_program_that_hangs(surrogym, tmp_path):
    plant = program(tmp_path, NOTES_ITSELF, HANGS, UNTERMINABLE)
    said = surrogym(
        "doctor", "--server", "http://127.0.0.1:9", "--env", f"exec:{plant}", "--step-limit", "0.5", "--json"
    )
    assert "the program did not answer step within" in found(said)["step"]["said"]
    assert (tmp_path / "pids").read_text()
    assert left_behind(tmp_path) == []


FAILING = """
import gymnasium

class Failing(gymnasium.Env):
    action_space = gymnasium.spaces.Box(-1, 1, (1,))
    observation_space = gymnasium.spaces.Box(-1, 1, (1,))

    def reset(self, *, seed=None, options=None):
        return self.observation_space.sample(), {}

    def step(self, action):
        raise RuntimeError("valve stuck")

gymnasium.register("Failing-v0", entry_point=Failing)
"""


def test_the_doctor_command_reports_a_failure_to_describe_the_environment_only_once(surrogym, tmp_path, monkeypatch):
    (tmp_path / "failing_env.py").write_text(FAILING)
    monkeypatch.syspath_prepend(tmp_path)
    said = surrogym("doctor", "--server", "http://127.0.0.1:9", "--env", "failing_env:Failing-v0", "--json")
    assert said.code == 1
    problem_of = found(said)["environment"]
    assert "failing_env:Failing-v0 failed after 0 real steps: RuntimeError: valve stuck" in problem_of["said"]
    assert "own-environment.md" in problem_of["way_out"]
