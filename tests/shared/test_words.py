"""Numbers agree with their nouns and verbs."""

import pytest

from surrogym_shared.words import counted, has


@pytest.mark.parametrize(("count", "said"), [(0, "0 rows"), (1, "1 row"), (2, "2 rows"), (2000, "2,000 rows")])
def test_counted_nouns_in_messages_are_singular_or_plural_by_number(count, said):
    assert counted(count, "row") == said


def test_verbs_in_messages_are_singular_or_plural_by_number():
    assert (has(1, "row"), has(3, "row")) == ("1 row has", "3 rows have")
