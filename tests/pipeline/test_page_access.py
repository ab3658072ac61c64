"""Who may use a page that viser serves: what other sites in the same browser can send is refused."""

from __future__ import annotations

import http.client
import socket
import time
from collections.abc import Iterator

import msgspec
import pytest
import viser
import websockets.asyncio.server
from click.testing import CliRunner
from viser import _messages
from websockets.exceptions import InvalidStatus
from websockets.sync.client import ClientConnection, connect

from pipeline.cli import main
from pipeline.errors import PipelineError
from pipeline.view.serving import address, close_server, open_server, page_server

DROP = """
name = "drop"
[[rigid]]
name = "ball"
kind = "dynamic"
density = 500.0
shape = { type = "sphere", radius = 0.1 }
position = [0.0, 0.0, 1.0]
"""


@pytest.fixture(scope="module")
def server() -> Iterator[viser.ViserServer]:
    with page_server(port=0, label="page") as server:
        server.gui.add_checkbox("box", initial_value=False)
        yield server


def joined(server: viser.ViserServer, *, origin: str | None, name: str = "127.0.0.1") -> ClientConnection:
    """A page's connection, by a name that leads to this machine."""
    port = server.get_port()
    return connect(
        f"ws://{name}:{port}",
        sock=socket.create_connection(("127.0.0.1", port)),
        origin=None if origin is None else origin.format(port=port),
        subprotocols=[f"viser-v{viser.__version__}"],
        max_size=None,
    )


@pytest.mark.parametrize("name", ["127.0.0.1", "localhost", "[::1]"])
def test_its_own_page_and_programs_are_let_in(server, name):
    for origin in (f"http://{name}:{{port}}", None):
        with joined(server, origin=origin, name=name) as page:
            assert page.recv(timeout=20)


@pytest.mark.parametrize("origin", ["http://evil.example", "http://127.0.0.1:1", "http://localhost:{port}", "null"])
def test_a_page_of_another_site_gets_nothing(server, origin):
    with pytest.raises(InvalidStatus) as refused:
        joined(server, origin=origin)
    assert refused.value.response.status_code == 403


def test_a_name_that_was_bent_to_this_machine_gets_nothing(server):
    with pytest.raises(InvalidStatus) as refused:
        joined(server, origin="http://evil.example:{port}", name="evil.example")
    assert refused.value.response.status_code == 403
    for host, status in (("evil.example", 403), (f"localhost:{server.get_port()}", 200)):
        page = http.client.HTTPConnection("127.0.0.1", server.get_port(), timeout=20)
        page.request("GET", "/", headers={"Host": host})
        assert page.getresponse().status == status
        page.close()


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "192.0.2.1", "studio-3", "a..b", "no such host", ""])
def test_an_address_that_others_reach_is_refused_and_ssh_is_named(host):
    with pytest.raises(PipelineError, match=f"--host {host}: others would reach the page.*ssh -L 8123:127.0.0.1:8123 "):
        open_server(host, 8123)


def test_live_says_so_before_it_builds_anything(tmp_path):
    (tmp_path / "drop.toml").write_text(DROP)
    outcome = CliRunner().invoke(main, ["live", str(tmp_path / "drop.toml"), "--host", "0.0.0.0", "--port", "0"])
    assert outcome.exit_code == 1
    assert "others would reach the page" in outcome.output


def test_nobody_opens_a_tunnel(server):
    asked = []
    server.request_share_url = lambda: asked.append("opened")  # else a mistake here would reach the world
    with joined(server, origin=None) as page:
        page.send(msgspec.msgpack.encode(_messages.ShareUrlRequest().as_serializable_dict()))
        assert page.ping().wait(20)
        time.sleep(0.3)
    assert asked == []


def test_opening_a_page_leaves_the_library_of_websockets_as_it_was():
    plain = websockets.asyncio.server.serve
    server = open_server("127.0.0.1", 0)
    assert websockets.asyncio.server.serve is plain
    close_server(server)


def test_an_address_of_ipv6_is_printed_in_brackets():
    if not socket.has_ipv6:
        pytest.skip("this Python has no IPv6")
    try:
        with socket.socket(socket.AF_INET6) as probe:
            probe.bind(("::1", 0))
    except OSError:
        pytest.skip("this machine has no IPv6")
    with page_server(host="::1", port=0, label="page") as server:
        assert address(server) == f"http://[::1]:{server.get_port()}"
