"""The server of the page: this computer only, one subject, the newest question first.

It listens on 127.0.0.1. Every address begins with a key that is made at its start, so that neither
another user of the computer nor a page of another site knows one. The Host header must name this
computer, else a site could reach it by a name of its own (DNS rebinding), and Origin, where there is
one, must be the page itself.
"""

import base64
import json
import secrets
import sys
import threading
import time
from collections.abc import Callable, Mapping
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
from typing import Any

import numpy as np
from plotly.offline import get_plotlyjs
from pydantic import Field, ValidationError

from dvax.app.explore.recent import Recent
from dvax.app.explore.subject import AbstractSubject, Answer, Drawing, Outdated, Question
from dvax.app.plots.theme import INK, MUTED, RULE, unit_text
from dvax.app.runs.schema import Section
from dvax.errors import DvaxError, InputError

ADDRESS = "127.0.0.1"
_MOST_BYTES = 2**16
_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self' 'unsafe-inline'; "
    "img-src 'self' data: blob:; connect-src 'self'; base-uri 'none'; form-action 'none'; "
    "frame-ancestors 'none'"
)
"""The browser itself refuses every other address. Plotly writes styles into the page."""


class SolveRequest(Section):
    """The body of /solve: a `Question`, and the number of the saved time that is shown,
    by default the middle one."""

    values: dict[str, float]
    base: dict[str, float]
    slider: str | None = None
    derivative: bool = False
    frame: int | None = Field(None, ge=0)


class FrameRequest(Section):
    """The body of /frame: the number of an answer, and that of a saved time."""

    answer: int
    frame: int = Field(ge=0)


class MapRequest(Section):
    """The body of /map: the values, and the parameters of both axes."""

    values: dict[str, float]
    across: str
    upward: str


class ExportRequest(Section):
    """The body of /export: "configuration" or "code"."""

    kind: str
    values: dict[str, float]


class Refused(Exception):
    """A request that the page does not make: its status, and the reason."""

    def __init__(self, status: HTTPStatus, reason: str):
        super().__init__(reason)
        self.status = status


class Server(ThreadingHTTPServer):
    """Serves the page of a subject at `url` until `shutdown`."""

    daemon_threads = True

    def __init__(self, subject: AbstractSubject, port: int = 0):
        super().__init__((ADDRESS, port), _Handler)
        self.subject = subject
        self.key = secrets.token_urlsafe(16)
        self.hosts = {f"{name}:{self.server_port}" for name in (ADDRESS, "localhost")}
        self.url = f"http://{ADDRESS}:{self.server_port}/{self.key}/"
        room = files("dvax.app.explore")
        page = {"": "page.html", "page.css": "page.css", "page.js": "page.js"}
        kinds = {"html": "text/html", "css": "text/css", "js": "text/javascript"}
        self.pages = {
            path: ((room / name).read_bytes(), kinds[name.rpartition(".")[2]])
            for path, name in page.items()
        }
        self.pages["plotly.js"] = get_plotlyjs().encode(), "text/javascript"
        self.actions: Mapping[str, tuple[type[Section], Callable[[Any], Any]]] = {
            "solve": (SolveRequest, self._solve),
            "frame": (FrameRequest, self._frame),
            "map": (MapRequest, self._map),
            "export": (ExportRequest, self._export),
        }
        self._turn, self._newest, self._counter = threading.Lock(), 0, threading.Lock()
        self._answers: Recent[Answer] = Recent(4)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Print the traceback of a defect; a browser that closes its connection is none."""
        if not isinstance(sys.exception(), ConnectionError | TimeoutError):
            super().handle_error(request, client_address)

    def describe(self) -> dict[str, Any]:
        """Return the title, the sliders and the buttons of the page."""
        s = self.subject
        return {
            "title": s.title,
            "subtitle": s.subtitle,
            "parameters": [
                {**vars(p), "unit": unit_text(p.unit)} for p in s.parameters
            ],
            "planes": list(s.planes),
            "exports": list(s.exports),
            "colours": {"ink": INK, "muted": MUTED, "rule": RULE},
        }  # fmt: skip

    def _solve(self, request: SolveRequest) -> dict[str, Any]:
        self._check_values(request.values)
        self._check_values(request.base)
        if request.slider is not None and request.slider not in request.values:
            raise Refused(HTTPStatus.BAD_REQUEST, "slider: no such parameter")
        with self._counter:
            self._newest += 1
            number = self._newest

        def check() -> None:
            if number != self._newest:
                raise Outdated

        started = time.perf_counter()
        with self._turn:
            check()
            question = Question(request.values, request.base, request.slider, request.derivative)
            answer = self.subject.solve(question, check)
        self._answers.put(number, answer)
        frames = answer.frames
        shown = None
        if frames is not None:
            last = len(frames.times) - 1
            frame = last // 2 if request.frame is None else min(request.frame, last)
            shown = {
                "times": np.asarray(frames.times, float).tolist(), "unit": unit_text(frames.unit),
                "frame": frame, "drawings": [_drawing(d) for d in frames.draw(frame)],
            }  # fmt: skip
        return {
            "answer": number,
            "drawings": [_drawing(d) for d in answer.drawings],
            "numbers": [vars(n) for n in answer.numbers],
            "certificate": vars(answer.certificate),
            "frames": shown,
            "prediction": answer.prediction,
            "hasMore": answer.has_more,
            "notes": answer.notes,
            "seconds": time.perf_counter() - started,
        }

    def _frame(self, request: FrameRequest) -> dict[str, Any]:
        answer = self._answers.get(request.answer)
        if answer is None or answer.frames is None:
            return {"outdated": True}
        frame = min(request.frame, len(answer.frames.times) - 1)
        return {"frame": frame, "drawings": [_drawing(d) for d in answer.frames.draw(frame)]}

    def _map(self, request: MapRequest) -> dict[str, Any]:
        self._check_values(request.values)
        if not {request.across, request.upward} <= set(self.subject.planes):
            raise Refused(HTTPStatus.BAD_REQUEST, "across, upward: no parameters of a plane")
        if request.across == request.upward:
            raise Refused(HTTPStatus.BAD_REQUEST, "across, upward: the same parameter twice")
        with self._turn:
            drawing = self.subject.stability_map(request.values, request.across, request.upward)
        return {"drawing": _drawing(drawing)}

    def _export(self, request: ExportRequest) -> dict[str, Any]:
        self._check_values(request.values)
        if request.kind not in self.subject.exports:
            raise Refused(HTTPStatus.BAD_REQUEST, "kind: no such export")
        name, text = self.subject.export(request.kind, request.values)
        return {"name": name, "text": text}

    def _check_values(self, values: Mapping[str, float]) -> None:
        if set(values) != {p.key for p in self.subject.parameters}:
            raise Refused(HTTPStatus.BAD_REQUEST, "values: not the parameters of the page")


class _Handler(BaseHTTPRequestHandler):
    """Pages by GET, actions by POST with a body of JSON."""

    server: Server
    protocol_version = "HTTP/1.1"
    disable_nagle_algorithm = True
    # A connection that sends nothing would keep a thread for ever.
    timeout = 60.0

    def do_GET(self) -> None:
        self._respond(self._page)

    def do_POST(self) -> None:
        self._respond(self._act)

    def log_message(self, format: str, *args: Any) -> None:
        """Print nothing: the terminal is for the address of the page."""

    def _respond(self, make: Callable[[str], tuple[bytes, str]]) -> None:
        status = HTTPStatus.OK
        try:
            body, kind = make(self._path())
        except Refused as refused:
            # The body may not have been read: the connection ends here.
            self.close_connection, status = True, refused.status
            body, kind = f"{refused}\n".encode(), "text/plain"
        self.send_response(status)
        for name, value in (
            ("Content-Type", f"{kind}; charset=utf-8"),
            ("Content-Length", str(len(body))),
            ("Content-Security-Policy", _POLICY),
            ("X-Content-Type-Options", "nosniff"),
            ("Referrer-Policy", "no-referrer"),
            ("Cross-Origin-Resource-Policy", "same-origin"),
            ("Cache-Control", "no-store"),
        ):
            self.send_header(name, value)
        if self.close_connection:
            self.send_header("Connection", "close")
        self.end_headers()
        self.wfile.write(body)

    def _path(self) -> str:
        """Return the path behind the key, after all checks of the sender."""
        host, origin = self.headers.get("Host"), self.headers.get("Origin")
        if host not in self.server.hosts:
            raise Refused(HTTPStatus.FORBIDDEN, "the Host header names another computer")
        if origin is not None and origin != f"http://{host}":
            raise Refused(HTTPStatus.FORBIDDEN, "the request comes from another page")
        _, key, *rest = self.path.partition("?")[0].split("/", 2)[:3] + [""] * 2
        if not secrets.compare_digest(key.encode(), self.server.key.encode()):
            raise Refused(HTTPStatus.NOT_FOUND, "no such page")
        return rest[0]

    def _page(self, path: str) -> tuple[bytes, str]:
        if path == "subject":
            return _encoded(self.server.describe())
        if path not in self.server.pages:
            raise Refused(HTTPStatus.NOT_FOUND, "no such page")
        return self.server.pages[path]

    def _act(self, path: str) -> tuple[bytes, str]:
        if path not in self.server.actions:
            raise Refused(HTTPStatus.NOT_FOUND, "no such action")
        kind, action = self.server.actions[path]
        request = self._request(kind)
        try:
            return _encoded(action(request))
        except Outdated:
            return _encoded({"outdated": True})
        except DvaxError as error:
            return _encoded({"error": _text(error)})
        except OSError as error:  # a data file was removed, say
            return _encoded({"error": f"{error.filename}: {error.strerror}. Make it accessible."})

    def _request(self, kind: type[Section]) -> Section:
        if self.headers.get_content_type() != "application/json":
            raise Refused(HTTPStatus.UNSUPPORTED_MEDIA_TYPE, "the body must be application/json")
        length = self.headers.get("Content-Length", "")
        if not length.isdecimal():
            raise Refused(HTTPStatus.LENGTH_REQUIRED, "Content-Length is required")
        if int(length) > _MOST_BYTES:
            raise Refused(
                HTTPStatus.REQUEST_ENTITY_TOO_LARGE, f"a body has at most {_MOST_BYTES} bytes"
            )
        try:
            return kind.model_validate_json(self.rfile.read(int(length)))
        except ValidationError as error:
            raise Refused(HTTPStatus.BAD_REQUEST, str(error)) from error


def _text(error: DvaxError) -> str:
    """Return an error as the page shows it: each problem, its rule and its fix."""
    if not isinstance(error, InputError):
        return str(error)
    return "\n".join(f"{p.place}: {p.given}; {p.rule}. {p.fix}" for p in error.problems)


def _drawing(drawing: Drawing) -> dict[str, Any]:
    views = drawing.views
    return {
        "key": drawing.key,
        "title": drawing.title,
        "caption": drawing.caption,
        "data": drawing.data,
        "layout": drawing.layout,
        "views": None if views is None else vars(views),
        "hasTime": drawing.has_time,
    }


def _encoded(content: Any) -> tuple[bytes, str]:
    return json.dumps(content, default=_array).encode(), "application/json"


def _array(value: Any) -> Any:
    """Return an array as Plotly reads it: its numbers in base64."""
    if isinstance(value, np.ndarray):
        shape = {"shape": ",".join(map(str, value.shape))} if value.ndim > 1 else {}
        data = base64.b64encode(value.tobytes()).decode()
        return {"dtype": value.dtype.str.lstrip("<|="), "bdata": data, **shape}
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"{type(value).__name__} has no JSON")
