"""Checks of a server that has no model yet: leases of queries, late samples, and repeated requests."""

from __future__ import annotations

import time

from surrogym_sampler.diagnosis.conformance.target import Target, answer
from surrogym_sampler.diagnosis.outcomes import expect

SHORT_LEASE = 0.3  # duration, in seconds, of a lease that a check lets expire


def a_lease_is_renewed_by_its_token_alone(target: Target) -> None:
    query = target.claim()
    path = f"surrogates/{target.surrogate}/queries/{query.id}"
    expect("renewal", True, target.post(f"{path}:renew", {"lease_token": query.lease_token}).is_success)
    foreign = target.post(f"{path}:renew", {"lease_token": "of-somebody-else"})
    target.refused("a renewal under a foreign token", foreign, 403, "foreign_lease")
    target.api.fail(target.surrogate, query.id, query.lease_token, "given back by the conformance suite")


def a_failed_query_is_given_out_again(target: Target) -> None:
    first = target.claim()
    target.api.fail(target.surrogate, first.id, first.lease_token, "given back by the conformance suite")
    statuses = {query.id: query.status for query in target.api.queries(target.surrogate)}
    expect("status of a query that failed once", "pending", statuses[first.id])


def a_late_answer_is_kept_once(target: Target) -> None:
    query = target.claim(SHORT_LEASE)
    time.sleep(2 * SHORT_LEASE)
    path = f"surrogates/{target.surrogate}"
    late = target.post(f"{path}/queries/{query.id}:renew", {"lease_token": query.lease_token})
    target.refused("a renewal of an expired lease", late, 409, "lease_expired")
    body = {"sampler": "conformance", "samples": [answer(query).model_dump(mode="json", exclude_none=True)]}
    first, again = (target.post(f"{path}/add_sample", body).json() for _ in range(2))
    expect("duplicates in the late answer", 0, first["duplicates"])
    expect("duplicates in its repeat", 1, again["duplicates"])
    expect("sample of the repeat", first["sample_ids"], again["sample_ids"])


def an_idempotency_key_stands_for_one_body(target: Target) -> None:
    path = f"surrogates/{target.surrogate}/ledger"
    body = {"steps": 3, "idempotency_key": "conformance"}
    first, again = (target.post(path, body) for _ in range(2))
    expect("status of a report", True, first.is_success)
    expect("ledger after a repeat", first.json(), again.json())
    target.refused("the key with another body", target.post(path, body | {"steps": 4}), 409, "idempotency_conflict")


def no_session_without_a_model(target: Target) -> None:
    reply = target.post(f"surrogates/{target.surrogate}/sessions", {})
    target.refused("a session without a model", reply, 409, "no_model")


CHECKS = (
    no_session_without_a_model,
    a_lease_is_renewed_by_its_token_alone,
    a_failed_query_is_given_out_again,
    a_late_answer_is_kept_once,
    an_idempotency_key_stands_for_one_body,
)
