"""API keys: a secret once, its digest for good, until it expires or is revoked."""

from __future__ import annotations

from datetime import timedelta
from pathlib import Path

import pytest

from service.catalog.catalog import Catalog
from service.catalog.keys import SCOPES, new_secret
from service.catalog.sql.tables import now
from service.errors import BadRequest, Conflict, NotFound
from service.settings import Settings

HEX = "spicd_" + "0123456789abcdef" * 4


def test_a_key_is_found_by_its_secret_alone(catalog: Catalog) -> None:
    key, secret = catalog.keys.add("robot 7", scopes=["surveys:write", "scans:write"], maps=["lobby"])
    assert secret.startswith("spicd_")
    assert len(secret) >= len("spicd_") + 43  # 256 bits, six in a letter
    assert catalog.keys.find(secret) == key
    assert key.scopes == ("scans:write", "surveys:write")
    assert key.maps == ("lobby",)
    assert catalog.keys.find(secret[:-1]) is None
    assert catalog.keys.find(new_secret()) is None
    assert catalog.keys.find("\udcff\x00") is None


def test_what_is_no_secret_of_ours_is_not_looked_for(
    catalog: Catalog, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(catalog.keys, "_database", None)
    for secret in ("", "nonsense", "spicd_short", "x" * 10_000, "spicd_" + "\u00e9" * 43):
        assert catalog.keys.find(secret) is None


def test_no_secret_is_written_to_the_disk(catalog: Catalog, settings: Settings) -> None:
    _, secret = catalog.keys.add("robot", scopes=["scans:write"])
    catalog.keys.find(secret)
    files = [path for path in settings.data_dir.rglob("*") if path.is_file()]
    assert files or settings.database_url
    for path in files:
        assert secret.removeprefix("spicd_").encode() not in path.read_bytes()


def test_a_revoked_key_is_taken_no_more(catalog: Catalog) -> None:
    key, secret = catalog.keys.add("robot", scopes=["admin"])
    assert catalog.keys.any_valid()
    revoked = catalog.keys.revoke(key.key_id)
    assert revoked.revoked is not None
    assert catalog.keys.revoke(key.key_id) == revoked
    assert catalog.keys.find(secret) is None
    assert not catalog.keys.any_valid()
    assert catalog.keys.all() == (revoked,)
    with pytest.raises(NotFound):
        catalog.keys.revoke("key-none")


def test_an_expired_key_is_taken_no_more(catalog: Catalog, monkeypatch: pytest.MonkeyPatch) -> None:
    _, secret = catalog.keys.add("guest", scopes=["changes:read"], expires=now() + timedelta(hours=1))
    assert catalog.keys.find(secret) is not None
    later = now() + timedelta(hours=2)
    monkeypatch.setattr("service.catalog.keys.now", lambda: later)
    assert catalog.keys.find(secret) is None
    assert not catalog.keys.any_valid()


def test_a_secret_made_elsewhere_gives_one_key_however_often_it_comes(catalog: Catalog) -> None:
    first, _ = catalog.keys.add("first", scopes=["admin"], secret=HEX)
    assert catalog.keys.add("first", scopes=["admin"], secret=HEX) == (first, HEX)
    catalog.keys.revoke(first.key_id)
    with pytest.raises(Conflict, match="revoked"):
        catalog.keys.add("first", scopes=["admin"], secret=HEX)


@pytest.mark.parametrize(
    ("given", "sentence"),
    [
        ({"name": " "}, "name"),
        ({"name": "a\nb"}, "name"),
        ({"scopes": []}, "at least one scope"),
        ({"scopes": ["scans:read"]}, "no scope 'scans:read'"),
        ({"maps": []}, "one map at least"),
        ({"maps": ["../x"]}, "cannot be the id"),
        ({"scopes": ["admin"], "maps": ["lobby"]}, "cannot be bound"),
        ({"expires": now() - timedelta(seconds=1)}, "would have expired"),
        ({"secret": "spicd_" + "a" * 42}, "256 random bits"),
        ({"secret": "a" * 64}, "256 random bits"),
    ],
)
def test_what_makes_no_key_is_refused_without_a_word_of_the_secret(
    catalog: Catalog, given: dict[str, object], sentence: str
) -> None:
    wanted = {"name": "robot", "scopes": ["scans:write"], **given}
    with pytest.raises(BadRequest, match=sentence) as caught:
        catalog.keys.add(**wanted)  # type: ignore[arg-type]
    assert "aaaa" not in str(caught.value)
    assert catalog.keys.all() == ()


def test_admin_may_everything_and_others_what_they_have(catalog: Catalog, tmp_path: Path) -> None:
    admin, _ = catalog.keys.add("admin", scopes=["admin"])
    robot, _ = catalog.keys.add("robot", scopes=["scans:write"])
    assert all(admin.may({scope}) for scope in SCOPES)
    assert robot.may({"scans:write", "admin"})
    assert not robot.may({"changes:read"})
