"""The audit fails for a known hole, and never for the lack of a network."""

from __future__ import annotations

import json

import pytest

from audit import verdict

SOUND = {"name": "sound", "version": "1", "vulns": []}
HOLED = {"name": "holed", "version": "2", "vulns": [{"id": "PYSEC-1"}]}
UNKNOWN = {"name": "unknown", "skip_reason": "not found"}


@pytest.mark.parametrize(
    ("output", "status", "said"),
    [
        ("", 0, "SKIPPED"),
        ("Traceback ...", 0, "SKIPPED"),
        (json.dumps({"dependencies": [UNKNOWN]}), 0, "SKIPPED: none of the 1"),
        (json.dumps({"dependencies": [SOUND, UNKNOWN]}), 0, "1 of 2 packages looked up, 0 known holes"),
        (json.dumps({"dependencies": [SOUND, HOLED]}), 1, "holed 2: PYSEC-1"),
    ],
)
def test_the_dependency_audit_fails_for_known_vulnerabilities_but_not_without_network(
    output: str, status: int, said: str
):
    assert verdict(output)[0] == status
    assert said in verdict(output)[1]
