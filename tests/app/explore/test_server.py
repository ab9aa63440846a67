"""The server: this computer only, the right host, the right key, well-formed questions."""

import http.client
import json
import threading
from collections.abc import Iterator
from typing import Any

import pytest
from tests.app.explore.line import Line

from dvax.app.explore.server import Server

SOLVE = {"values": {"a": 2.0}, "base": {"a": 2.0}}


@pytest.fixture
def server() -> Iterator[Server]:
    made = Server(Line())
    thread = threading.Thread(target=made.serve_forever, kwargs={"poll_interval": 0.02})
    thread.start()
    yield made
    made.shutdown()
    thread.join()
    made.server_close()


def ask(
    server: Server,
    path: str,
    body: Any = None,
    key: str | None = None,
    **headers: str,
) -> tuple[int, str, http.client.HTTPMessage]:
    connection = http.client.HTTPConnection("127.0.0.1", server.server_port, timeout=20)
    given = {name.replace("_", "-"): value for name, value in headers.items()}
    content = body if body is None or isinstance(body, str) else json.dumps(body)
    if body is not None:
        given.setdefault("Content-Type", "application/json")
    method = "GET" if body is None else "POST"
    address = f"/{server.key if key is None else key}/{path}"
    connection.request(method, address, content, given)
    answer = connection.getresponse()
    text = answer.read().decode()
    connection.close()
    return answer.status, text, answer.headers


def test_server_listens_on_the_loopback_address_only(server: Server) -> None:
    assert server.server_address[0] == "127.0.0.1"
    assert server.url == f"http://127.0.0.1:{server.server_port}/{server.key}/"


def test_server_serves_a_page_that_may_load_from_itself_alone(server: Server) -> None:
    status, text, headers = ask(server, "")
    assert status == 200 and "<h1" in text
    assert "http://" not in text and "https://" not in text
    assert headers["Content-Security-Policy"].startswith("default-src 'none'")
    assert "Access-Control-Allow-Origin" not in headers
    for path in ("page.css", "page.js", "plotly.js"):
        assert ask(server, path)[0] == 200


@pytest.mark.parametrize("host", ["evil.example", "evil.example:80", "127.0.0.1", "localhost:1"])
def test_server_refuses_another_host(server: Server, host: str) -> None:
    for body in (None, SOLVE):
        status, text, _ = ask(server, "solve", body, Host=host)
        assert (status, "Host" in text) == (403, True)


def test_server_accepts_localhost_as_its_name(server: Server) -> None:
    assert ask(server, "subject", Host=f"localhost:{server.server_port}")[0] == 200


@pytest.mark.parametrize("origin", ["http://evil.example", "null", "https://127.0.0.1:1"])
def test_server_refuses_another_origin(server: Server, origin: str) -> None:
    assert ask(server, "solve", SOLVE, Origin=origin)[0] == 403


def test_server_accepts_the_origin_of_its_page(server: Server) -> None:
    origin = f"http://127.0.0.1:{server.server_port}"
    assert ask(server, "solve", SOLVE, Origin=origin)[0] == 200


@pytest.mark.parametrize("key", ["", "wrong", "é"])
def test_server_needs_its_key(server: Server, key: str) -> None:
    from urllib.parse import quote

    assert ask(server, "subject", key=quote(key))[0] == 404
    assert ask(server, "solve", SOLVE, key=quote(key))[0] == 404


@pytest.mark.parametrize("path", ["nothing", "../page.py", "page.html", "page.js/x", "solve"])
def test_server_has_no_other_page(server: Server, path: str) -> None:
    assert ask(server, path)[0] == 404


def test_server_has_no_other_action(server: Server) -> None:
    assert ask(server, "subject", {})[0] == 404


@pytest.mark.parametrize(
    "body",
    [
        "",
        "{",
        "[]",
        "{}",
        '{"values": {"a": NaN}, "base": {"a": 1}}',
        '{"values": {"a": 1e999}, "base": {"a": 1}}',
        '{"values": {"a": "1"}, "base": {"a": 1}}',
        '{"values": {}, "base": {"a": 1}}',
        '{"values": {"a": 1, "b": 2}, "base": {"a": 1}}',
        '{"values": {"a": 1}, "base": {"a": 1}, "slider": "b"}',
        '{"values": {"a": 1}, "base": {"a": 1}, "frame": -1}',
        '{"values": {"a": 1}, "base": {"a": 1}, "more": 1}',
    ],
)
def test_server_refuses_malformed_questions(server: Server, body: str) -> None:
    assert ask(server, "solve", body)[0] == 400


@pytest.mark.parametrize(
    ("path", "body"),
    [
        ("map", {"values": {"a": 1.0}, "across": "a", "upward": "a"}),
        ("export", {"values": {"a": 1.0}, "kind": "password"}),
    ],
)
def test_server_refuses_actions_that_the_subject_lacks(
    server: Server, path: str, body: Any
) -> None:
    assert ask(server, path, body)[0] == 400


def test_server_refuses_bodies_that_a_form_can_send(server: Server) -> None:
    # A form of another page sends these without asking; JSON it cannot.
    for kind in ("text/plain", "application/x-www-form-urlencoded"):
        assert ask(server, "solve", json.dumps(SOLVE), Content_Type=kind)[0] == 415


def test_server_refuses_large_bodies(server: Server) -> None:
    assert ask(server, "solve", " " * 100_000)[0] == 413


def test_server_answers_with_drawings_numbers_and_the_frame(server: Server) -> None:
    status, text, _ = ask(server, "solve", SOLVE)
    answer = json.loads(text)
    assert status == 200
    assert answer["numbers"][0]["text"] == "2"
    assert answer["drawings"][0]["data"][0]["y"]["dtype"] == "f4"
    assert answer["frames"]["frame"] == 5
    frame = json.loads(ask(server, "frame", {"answer": answer["answer"], "frame": 3})[1])
    assert frame["drawings"][0]["title"] == "Level at t = 0.3 s"
    assert json.loads(ask(server, "frame", {"answer": 99, "frame": 3})[1]) == {"outdated": True}
    export = json.loads(ask(server, "export", {"values": {"a": 3.0}, "kind": "configuration"})[1])
    assert export == {"name": "line.toml", "text": "a = 3.0\n"}


def test_server_reports_input_that_a_subject_refuses(server: Server) -> None:
    status, text, _ = ask(server, "solve", {"values": {"a": 9.5}, "base": {"a": 1.0}})
    assert status == 200
    assert json.loads(text) == {"error": "a: 9.5; it is at most 9. Move it back"}


def test_server_drops_a_question_when_a_newer_one_arrives(server: Server) -> None:
    subject = server.subject
    assert isinstance(subject, Line)
    first, release, answers = threading.Event(), threading.Event(), {}

    def wait() -> None:
        if not first.is_set():
            first.set()
            release.wait(20)

    subject.wait = wait

    def question(a: float) -> None:
        answers[a] = json.loads(ask(server, "solve", {"values": {"a": a}, "base": {"a": a}})[1])

    threads = [threading.Thread(target=question, args=(a,)) for a in (1.0, 2.0)]
    threads[0].start()
    assert first.wait(20)
    threads[1].start()
    while server._newest < 2:
        pass
    release.set()
    for thread in threads:
        thread.join()
    assert answers[1.0] == {"outdated": True}
    assert answers[2.0]["numbers"][0]["text"] == "2"
