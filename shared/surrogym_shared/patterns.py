"""Regular expressions for texts in requests and specifications, each with a description for error messages."""

from __future__ import annotations

NAME = r"^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$"
# A text without control characters, because people see it.
VISIBLE = r"^[^\x00-\x1f\x7f-\x9f\u2028-\u202e\u2066-\u2069]*$"
ALIAS = r"^[a-z][a-z0-9_-]{0,31}$"
POLICY = r"^[a-z0-9][a-z0-9_-]{0,31}$"
DIGEST = r"^[0-9a-f]{64}$"
TOKEN = r"^[!-~]([ -~]*[!-~])?$"

IN_WORDS = {
    NAME: "1 to 64 letters, digits, '.', '_' or '-', the first a letter or a digit",
    VISIBLE: "text in one line without control characters",
    ALIAS: "1 to 32 lower-case letters, digits, '_' or '-', the first a letter",
    POLICY: "the version or the alias of a policy, in lower case",
    TOKEN: "letters, digits and signs of ASCII, without a space at either end",
    DIGEST: "a SHA-256 as 64 hexadecimal digits in lower case",
}
