"""Serving of pages: ports, connections, and which requests to a viser page are refused."""

import asyncio
import http.client
import socket
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import msgspec
import pytest
import viser
import websockets.asyncio.server
from browser import until
from click.testing import Result
from command_line import pipeline
from probes import probe
from starlette.types import Receive, Scope, Send
from uvicorn.server import ServerState
from viser import _messages
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect

from pipeline.base.errors import PipelineError
from pipeline.web.serving import address, config_of, in_its_loop, listen, page_server, remark_of

DROP = """
name = "drop"
[[rigid]]
name = "ball"
kind = "dynamic"
density = 500.0
shape = { type = "sphere", radius = 0.1 }
position = [0.0, 0.0, 1.0]
"""


def live(folder: Path, *options: object) -> Result:
    (folder / "drop.toml").write_text(DROP)
    return pipeline("live", folder / "drop.toml", *options)


def opened(host: str, port: int) -> None:
    with page_server(host=host, port=port):
        pass


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


@pytest.mark.parametrize(
    "message",
    [
        pytest.param(b"", id="empty"),
        pytest.param(b"\xff\x00", id="no message"),
        pytest.param("hello", id="text"),
        pytest.param(msgspec.msgpack.encode([1]), id="a list"),
        pytest.param(msgspec.msgpack.encode({"type": "Bomb"}), id="unknown type"),
        pytest.param(
            msgspec.msgpack.encode({"type": "GuiUpdateMessage", "uuid": 1, "x": "y" * 5000}), id="other fields"
        ),
    ],
)
def test_a_message_that_cannot_be_read_costs_a_line(server, message, caplog, capfd):
    with joined(server, origin=None) as page, pytest.raises(ConnectionClosed):
        page.send(message)
        while page.recv(timeout=20):
            pass
    until(lambda: caplog.records, "nothing is told")
    (record,) = caplog.records
    assert record.exc_info is None
    assert "a message of a page was not understood" in record.getMessage()
    assert len(record.getMessage()) < 300
    assert "Traceback" not in capfd.readouterr().err
    with joined(server, origin=None) as page:
        assert page.recv(timeout=20)


def test_a_scan_of_ports_costs_no_traceback_and_the_page_goes_on(server, caplog, capfd):
    probe(server.get_port())
    with joined(server, origin=None) as page:
        assert page.recv(timeout=20)
    assert [record.getMessage() for record in caplog.records if record.exc_info] == []
    assert "Traceback" not in capfd.readouterr().err


def test_what_is_done_in_its_loop_is_done_there_and_its_error_comes_back(server):
    where = in_its_loop(server, threading.get_ident)
    assert where != threading.get_ident()
    assert where == in_its_loop(server, threading.get_ident)
    with pytest.raises(ZeroDivisionError):
        in_its_loop(server, lambda: 1 // 0)


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
        opened(host, 8123)


def test_live_says_so_before_it_builds_anything(tmp_path):
    outcome = live(tmp_path, "--host", "0.0.0.0", "--port", "0")
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


def test_opening_a_page_prints_nothing_and_leaves_the_library_of_websockets_as_it_was(capsys):
    plain = websockets.asyncio.server.serve
    with page_server() as server:
        assert websockets.asyncio.server.serve is plain
        assert address(server) == f"http://localhost:{server.get_port()}/"
    assert capsys.readouterr().out == ""


def test_an_address_of_ipv6_is_printed_in_brackets():
    if not socket.has_ipv6:
        pytest.skip("this Python has no IPv6")
    try:
        with socket.socket(socket.AF_INET6) as probe:
            probe.bind(("::1", 0))
    except OSError:
        pytest.skip("this machine has no IPv6")
    with page_server(host="::1", port=0, label="page") as server:
        assert address(server) == f"http://[::1]:{server.get_port()}/"


@pytest.mark.parametrize("opens", [listen, opened])
def test_a_port_that_is_taken_is_told_and_a_free_one_named(opens):
    with listen("127.0.0.1", 0) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(PipelineError, match=rf"port {port} of 127.0.0.1 is taken; .*--port \d+, or --port 0"):
            opens("127.0.0.1", port)


def test_a_command_on_a_port_that_is_taken_ends_with_that_line(tmp_path):
    with listen("127.0.0.1", 0) as taken:
        port = taken.getsockname()[1]
        outcome = pipeline("dashboard", "--farm", tmp_path, "--port", port)
    assert outcome.exit_code == 1
    assert f"port {port} of 127.0.0.1 is taken" in outcome.output


def test_without_a_package_of_the_extra_commands_say_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)  # as Python marks what it could not import
    (tmp_path / "job").mkdir()
    (tmp_path / "job" / "job.toml").write_text(DROP)
    for outcome in (live(tmp_path), pipeline("view", tmp_path / "job"), pipeline("dashboard", "--farm", tmp_path)):
        assert outcome.exit_code == 3
        assert 'need viser: install the extra "view"' in outcome.output


def test_a_name_that_stands_for_the_loopback_is_remarked_on() -> None:
    with listen("127.0.1.1", 0) as listening:  # as Debian lets a machine's own name stand for
        assert "studio-3 is 127.0.1.1 on this machine" in remark_of(listening, "studio-3")
        assert remark_of(listening, "127.0.1.1") == remark_of(listening, "localhost") == ""
    with listen("0.0.0.0", 0) as listening:
        assert remark_of(listening, "studio-3") == ""


def test_many_connections_that_say_nothing_keep_nobody_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pipeline.web.serving.MOST_OF_ADDRESS", 8)
    monkeypatch.setattr("pipeline.web.serving.MOST_CONNECTIONS", 20)

    async def answer(_scope: Scope, _receive: Receive, send: Send) -> None:
        await send({"type": "http.response.start", "status": 200, "headers": [(b"content-length", b"2")]})
        await send({"type": "http.response.body", "body": b"ok"})

    async def try_all() -> list[bytes]:
        config = config_of(answer)
        config.load()
        protocol, state, loop = config.http_protocol_class, ServerState(), asyncio.get_running_loop()
        server = await loop.create_server(
            lambda: protocol(config=config, server_state=state, app_state={}), "127.0.0.1", 0
        )
        port = server.sockets[0].getsockname()[1]
        silent = [
            await asyncio.open_connection("127.0.0.1", port, local_addr=(f"127.0.0.{host}", 0))
            for host in (1, 2, 3, 4)
            for _ in range(12)
        ]
        assert len(state.connections) <= 20

        async def asked(host: int) -> bytes:
            reader, writer = await asyncio.open_connection("127.0.0.1", port, local_addr=(f"127.0.0.{host}", 0))
            writer.write(b"GET / HTTP/1.1\r\nHost: a\r\nConnection: close\r\n\r\n")
            said = await asyncio.wait_for(reader.read(), 4.0)
            writer.close()
            return said

        said = [await asked(host) for host in (1, 9)]
        for _, writer in silent:
            writer.close()
        server.close()
        return said

    assert all(each.startswith(b"HTTP/1.1 200") for each in asyncio.run(try_all()))


def test_a_connection_without_a_whole_request_is_closed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pipeline.web.serving.REQUEST_S", 0.3, raising=False)

    async def answer(_scope: Scope, _receive: Receive, send: Send) -> None:
        await asyncio.sleep(0.6)  # a slow answer is none of its business
        await send({"type": "http.response.start", "status": 200, "headers": [(b"content-length", b"2")]})
        await send({"type": "http.response.body", "body": b"ok"})

    async def try_all() -> list[bytes]:
        config = config_of(answer)
        config.load()
        protocol, state = config.http_protocol_class, ServerState()
        loop = asyncio.get_running_loop()
        server = await loop.create_server(
            lambda: protocol(config=config, server_state=state, app_state={}), "127.0.0.1", 0
        )
        port = server.sockets[0].getsockname()[1]

        async def said_to(request: bytes) -> bytes:
            reader, writer = await asyncio.open_connection("127.0.0.1", port)
            writer.write(request)
            said = await asyncio.wait_for(reader.read(), 4.0)  # to the connection's end
            writer.close()
            return said

        head = b"/ HTTP/1.1\r\nHost: a\r\n"
        requests = (
            b"",
            b"GET " + head,
            b"GET " + head + b"Connection: close\r\n\r\n",
            b"POST " + head + b"Content-Length: 9\r\nConnection: close\r\n\r\nx",
        )
        said = await asyncio.gather(*map(said_to, requests))
        server.close()
        return said

    said = asyncio.run(try_all())
    assert said[0] == said[1] == said[3] == b""
    assert said[2].startswith(b"HTTP/1.1 200")
    assert said[2].endswith(b"ok")
