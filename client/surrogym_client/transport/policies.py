"""One typed method for each route of policies."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence

from surrogym_client.transport import routes
from surrogym_client.transport.connection import Connection
from surrogym_client.transport.replies import parse
from surrogym_shared import wire

_FILE = "application/octet-stream"
_SECONDS = 300.0  # time-out of a file's transfer, enough for the largest file over a slow connection


class PolicyCalls:
    """Methods for the routes of stored policies. ``which`` is the version of a policy, an alias, or ``latest``.

    Every method raises the errors of ``Api``, and ``UnknownPolicy`` for a policy that does not exist.
    """

    def __init__(self, connection: Connection) -> None:
        self._connection = connection

    def list(self, surrogate: str) -> list[wire.PolicyView]:
        """List all policies of a surrogate, newest first."""
        route = f"{routes.surrogate(surrogate)}/policies"
        return parse(wire.PolicyList, self._connection.send("GET", route), route).policies

    def get(self, surrogate: str, which: str | int = "latest") -> wire.PolicyDetail:
        """Return one policy, with the settings and the curve of its training."""
        route = routes.policy(surrogate, which)
        return parse(wire.PolicyDetail, self._connection.send("GET", route), route)

    def push(
        self,
        surrogate: str,
        card: wire.PushedCard,
        curve: Sequence[wire.CurvePoint],
        form: wire.PolicyForm,
        file: bytes,
    ) -> wire.PushedPolicy:
        """Store a policy with its file. A version never changes: the same file with another card is a new version.

        Raises:
            SpecConflict: the policy was made for other observations or actions.
            InvalidInput: the file is not of this form.
        """
        notice = wire.FileNotice(form=form, bytes=len(file), digest=_digest(file))
        body = wire.AddPolicy(card=card, curve=[*curve], file=notice)
        route = f"{routes.surrogate(surrogate)}/policies"
        pushed = parse(wire.PushedPolicy, self._connection.send("POST", route, body.model_dump_json().encode()), route)
        if not all(one.stored for one in pushed.files if one.form == form):
            stored = self.put_file(surrogate, pushed.version, form, file)
            return wire.PushedPolicy(**stored.model_dump(), created=pushed.created)
        return pushed

    def put_file(self, surrogate: str, version: int, form: wire.PolicyForm, file: bytes) -> wire.PolicyView:
        """Store a further file of a policy. A stored file is never replaced: another file of the same form is an
        error."""
        route = f"{routes.policy(surrogate, version)}/files/{form}"
        digest = {"digest": _digest(file)}
        reply = self._connection.send("PUT", route, file, params=digest, media_type=_FILE, timeout=_SECONDS)
        return parse(wire.PolicyView, reply, route)

    def file(self, surrogate: str, which: str | int, form: wire.PolicyForm) -> bytes:
        """Return the content of a policy's file."""
        return self._connection.send("GET", f"{routes.policy(surrogate, which)}/files/{form}", timeout=_SECONDS)

    def evaluate(self, surrogate: str, version: int, evaluation: wire.AddEvaluation) -> wire.EvaluationView:
        """Store the results of real episodes of a policy, once for each idempotency key. This does not change the
        surrogate's counts of real steps, see ``Api.report_steps``."""
        route = f"{routes.policy(surrogate, version)}/evaluations"
        reply = self._connection.send("POST", route, evaluation.model_dump_json().encode())
        return parse(wire.EvaluationView, reply, route)

    def evaluation(self, surrogate: str, which: str | int, id: int) -> wire.EvaluationDetail:
        """Return the results of a stored evaluation: the return of each real episode, and the traces of some."""
        route = f"{routes.policy(surrogate, which)}/evaluations/{id}"
        return parse(wire.EvaluationDetail, self._connection.send("GET", route), route)

    def put_alias(self, surrogate: str, alias: str, version: int) -> wire.PolicyView:
        """Point an alias to a version of the policies. This needs a token of role admin."""
        route = f"{routes.policy(surrogate, 'aliases')}/{routes.alias(alias)}"
        reply = self._connection.send("PUT", route, wire.PutAlias(version=version).model_dump_json().encode())
        return parse(wire.PolicyView, reply, route)

    def drop_alias(self, surrogate: str, alias: str) -> None:
        """Remove an alias. This needs a token of role admin."""
        self._connection.send("DELETE", f"{routes.policy(surrogate, 'aliases')}/{routes.alias(alias)}")

    def delete(self, surrogate: str, version: int) -> None:
        """Delete a policy with its files and evaluations. This needs a token of role admin."""
        self._connection.send("DELETE", routes.policy(surrogate, version))


def _digest(file: bytes) -> str:
    return hashlib.sha256(file).hexdigest()
