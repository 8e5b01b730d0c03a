"""Numbers agree with their nouns and verbs."""

import pytest

from surrogym_shared.words import counted, has


@pytest.mark.parametrize(("count", "said"), [(0, "0 rows"), (1, "1 row"), (2, "2 rows"), (2000, "2,000 rows")])
def test_a_number_agrees_with_its_noun(count, said):
    assert counted(count, "row") == said


def test_a_number_agrees_with_its_verb():
    assert (has(1, "row"), has(3, "row")) == ("1 row has", "3 rows have")
