"""What a file of a policy looks like from outside costs a server little, whatever the file is."""

from __future__ import annotations

import hashlib
import io
import tracemalloc
import zipfile

import pytest

from surrogym_server.errors import InvalidInput
from surrogym_server.features.policies.service import MOST_ENTRIES, check_file


def zipped(entries: int) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        for number in range(entries - 2):
            archive.writestr(str(number), b"")
        archive.writestr("data", b"{}")
        archive.writestr("policy.pth", b"")
    return file.getvalue()


def test_a_policy_zip_with_too_many_entries_is_refused_before_listing_it():
    content = zipped(2 * MOST_ENTRIES)
    digest = hashlib.sha256(content).hexdigest()
    tracemalloc.start()
    try:
        with pytest.raises(InvalidInput, match="expected a zip of Stable-Baselines3"):
            check_file("zip", content, len(content), digest)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < len(content) / 10


def test_a_policy_zip_with_many_entries_is_accepted():
    content = zipped(MOST_ENTRIES)
    check_file("zip", content, len(content), hashlib.sha256(content).hexdigest())
