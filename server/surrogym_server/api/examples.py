"""Example bodies for the documentation of the API. A test validates each of them."""

from __future__ import annotations

from typing import Any

Example = dict[str, Any]


def _linear(name: str) -> Example:
    return {"parts": [{"function": "linear", "weights": {name: 1}}]}


PENDULUM: Example = {
    "environment": "Pendulum-v1",
    "coordinates": [
        {"name": "theta", "kind": "angle", "sampling": {"kind": "uniform", "low": -3.1416, "high": 3.1416}},
        {
            "name": "theta_dot",
            "sampling": {"kind": "uniform", "low": -8, "high": 8},
            "bounds": {"low": -8, "high": 8},
        },
    ],
    "observation": [
        {
            "name": "cos",
            "term": {"parts": [{"function": "cos", "weights": {"theta": 1}}]},
            "low": -1,
            "high": 1,
        },
        {
            "name": "sin",
            "term": {"parts": [{"function": "sin", "weights": {"theta": 1}}]},
            "low": -1,
            "high": 1,
        },
        {"name": "theta_dot", "term": _linear("theta_dot"), "low": -8, "high": 8},
    ],
    "action": {"kind": "box", "low": [-2], "high": [2]},
    "start": {
        "theta": {"kind": "uniform", "low": -3.1416, "high": 3.1416},
        "theta_dot": {"kind": "uniform", "low": -1, "high": 1},
    },
    "time_limit": 200,
}
CREATE: Example = {"name": "pendulum", "spec": PENDULUM}
PATCH: Example = {"paused": True}
CLAIM: Example = {"sampler": "bench-1", "max_queries": 1, "wait_seconds": 20, "lease_seconds": 60}
RENEW: Example = {"lease_token": "the token of the claim", "lease_seconds": 60}
FAIL: Example = {"lease_token": "the token of the claim", "error": "the motor did not answer"}
DROP_SNAPSHOTS: Example = {"snapshots": ["4f1c09aa-17"]}
WITHDRAW: Example = {"query_ids": [7, 8]}
ADD_QUERIES: Example = {"coordinates": [[0.1, 0.0]], "action": [[1.5]], "idempotency_key": "by-hand-1"}
ADD_SAMPLE: Example = {
    "sampler": "bench-1",
    "idempotency_key": "bench-1/17",
    "samples": [
        {
            "coordinates": [0.1, 0.0],
            "action": [1.5],
            "next_coordinates": [0.115, 0.3],
            "reward": -0.01225,
            "terminated": False,
        }
    ],
}
DRAFT_LOG: Example = {
    "text": "level,action_valve,reward\n1.0,0.5,-1\n1.1,0.4,-1.2\n1.2,0.3,-1.4\n",
    "environment": "tank",
}
ADD_LOG: Example = {
    "text": "theta,theta_dot,action_torque,reward\n0.1,0.0,1.5,-0.01\n0.115,0.3,-0.5,-0.02\n0.13,0.2,0.1,-0.02\n",
    "check_only": True,
}
LEDGER: Example = {"steps": 20_000, "episodes": 100, "note": "ppo.zip", "idempotency_key": "evaluation-1"}
IMPROVE: Example = {"queries": 5, "checkpoint": "after-100k-steps", "idempotency_key": "improve-1"}
POINTS: Example = {"coordinates": [[0.1, 0.0]], "action": [[1.5]]}
IMAGINE: Example = {"coordinates": [0.1, 0.0], "actions": [[1.5], [1.5]], "draws": 2, "seed": 0}
OPEN: Example = {"num_envs": 2, "seed": 0, "autoreset_mode": "next_step", "idempotency_key": "run-7"}
RESET: Example = {"seq": 1, "seed": 0}
STEP: Example = {"seq": 2, "action": [[1.5], [-0.5]]}
ROLLOUT: Example = {"seq": 3, "actions": [[[1.5], [-0.5]], [[1.0], [0.0]]]}
OCCUPANCY: Example = {"checkpoint": "after-100k-steps"}
