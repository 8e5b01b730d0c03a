"""What a front server says before it has reached a cluster."""

from __future__ import annotations

import pytest

from surrogym_server.errors import InvalidInput
from surrogym_server.features.ray import pool
from surrogym_server.settings import Settings

ray = pytest.importorskip("ray")

pytestmark = pytest.mark.filterwarnings("ignore::FutureWarning:ray")


def test_a_cluster_with_another_ray_version_is_refused_in_one_sentence(monkeypatch: pytest.MonkeyPatch):
    """Ray compares its version and Python's itself, in several lines."""

    def init(*_: object, **__: object) -> None:
        raise RuntimeError("Version mismatch: The cluster was started with:\n    Ray: 2.50.0\n    Python: 3.11.2\n")

    monkeypatch.setattr(ray, "init", init)
    settings = Settings(database="postgresql+psycopg://here/there", engine="ray")
    with pytest.raises(
        InvalidInput, match=r"expected a cluster with this server's versions of Ray and Python: .* Ray: 2\.50\.0"
    ) as refused:
        pool.connect(settings, None)  # type: ignore[arg-type]
    assert "\n" not in str(refused.value)


def test_without_ray_installed_the_error_tells_how_to_install_it(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(pool, "find_spec", lambda _: None)
    with pytest.raises(InvalidInput, match=r"pip install 'surrogym\[ray\]'"):
        pool.check(Settings(database="postgresql+psycopg://here/there", engine="ray"))
