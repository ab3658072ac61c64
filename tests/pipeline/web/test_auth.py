"""Access to the dashboard: hosts, sessions, tokens."""

import secrets
import socket
from pathlib import Path
from types import SimpleNamespace

import pytest

from pipeline.base.errors import PipelineError
from pipeline.web.auth import Access, access_of, host_of


@pytest.mark.parametrize(
    ("header", "name"),
    [("a.b:1", "a.b"), ("A.B", "a.b"), ("[::1]:80", "::1"), ("[::1]", "::1"), ("", "")]
    + [(odd, "") for odd in ("::1", "127.0.0.1:80@evil", "a@127.0.0.1", "127.0.0.1/", "[::1]evil", "a:b", "a:1:2")],
)
def test_hosts_are_read_from_headers(header: str, name: str) -> None:
    assert host_of(header) == name


def test_sessions_are_signed_and_forms_belong_to_one() -> None:
    access = Access("127.0.0.1", 80, None)
    cookie, other = access.new_session(), access.new_session()
    session = access.session(cookie)
    assert session is not None
    assert access.is_form_token(session, access.form_token(session))
    assert not access.is_form_token(access.session(other) or "", access.form_token(session))
    assert not access.is_form_token(session, cookie.rpartition(".")[2])  # a session's signature opens no form
    for forged in (None, "", ".", session, f"{session}.", f"x{cookie}", cookie[:-1], "ü.ü"):
        assert access.session(forged) is None
    assert Access("127.0.0.1", 80, None).session(cookie) is None  # of another start


def test_only_addresses_and_own_names_are_known_hosts() -> None:
    near, far = Access("127.0.0.1", 80, None), Access("192.168.1.5", 80, "t" * 20)
    assert near.knows_host("127.0.0.1:80")
    assert not near.knows_host("192.168.1.5:80")
    assert far.knows_host("192.168.1.5:80")
    assert not far.knows_host("studio.example:80")
    assert Access("studio.example", 80, "t" * 20).knows_host("Studio.example:80")


def test_own_names_are_asked_for_once_and_not_by_requests(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[int] = []
    monkeypatch.setattr(socket, "getfqdn", lambda: asked.append(1) or "Studio-3.Example")
    access = Access("0.0.0.0", 80, "t" * 20)
    assert [access.knows_host(name) for name in ("studio-3.example:80", "other.example", "a.b")] == [True, False, False]
    assert asked == [1]
    Access("127.0.0.1", 80, None)
    assert asked == [1]


def test_a_session_ends_and_its_end_is_signed(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [1e9]
    monkeypatch.setattr("pipeline.web.auth.time", SimpleNamespace(time=lambda: now[0]), raising=False)
    access = Access("127.0.0.1", 80, None)
    cookie = access.new_session()
    name, end, signature = cookie.split(".")
    now[0] += 6 * 24 * 3600
    assert access.session(cookie) == f"{name}.{end}"
    assert access.session(f"{name}.{int(end) + 10**6}.{signature}") is None
    now[0] += 25 * 3600
    assert access.session(cookie) is None


@pytest.mark.parametrize(
    "token", ["1234", "a" * 40, "password" * 3, "0123456789abcdef01234", "12" * 30, "x" * 9000, "a b\nc" * 9]
)
def test_tokens_that_can_be_guessed_are_refused(tmp_path: Path, token: str) -> None:
    path = tmp_path / "token"
    path.write_text(token)
    path.chmod(0o600)
    with pytest.raises(PipelineError, match="22 characters at least, drawn at random"):
        access_of("127.0.0.1", 80, path)
    with pytest.raises(PipelineError, match="missing cannot be read"):
        access_of("127.0.0.1", 80, tmp_path / "missing")


def test_a_token_that_others_can_read_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "token"
    path.write_text(f"{secrets.token_urlsafe(32)}\n")
    for mode in (0o640, 0o604, 0o620, 0o602):
        path.chmod(mode)
        with pytest.raises(PipelineError, match="chmod 600"):
            access_of("127.0.0.1", 80, path)
    path.chmod(0o600)
    first, again = access_of("127.0.0.1", 80, path), access_of("127.0.0.1", 80, path)
    assert again.session(first.new_session()) is not None  # sessions outlive the program
    for token in (secrets.token_urlsafe(32), secrets.token_hex(16)):
        path.write_text(token)
        assert access_of("127.0.0.1", 80, path).is_token(token)
