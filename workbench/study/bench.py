"""The bench: a local web page on which a design is changed by hand and evaluated at once."""

import json
from contextlib import suppress
from functools import partial
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from socket import SHUT_RDWR, socket
from threading import Timer
from typing import Any

from jinja2 import Environment

from workbench.records.units import SI, Units
from workbench.rig.rig import Rig
from workbench.structure.domain import NamedPoints
from workbench.study.design_evaluation import design_from, results_of, setting
from workbench.study.pages.page import asset, in_script
from workbench.study.runs.cases import StudyError
from workbench.study.saved_design import save

HERE = "127.0.0.1"
DRAG = "Drag a triangle (actuator), a circle (sensor) or the hammer{}; the arrow keys move them too."
MOST_BYTES = 65536
CLIENT_SECONDS = 10.0  # time limit of a whole request, after which the connection is closed
MOST_WAITING = 128  # connections not yet accepted
POLICY = (
    "default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'unsafe-inline'; connect-src 'self';"
    " base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)


def bench_server(
    rig: Rig, structure: str, units: Units = SI, *, port: int = 0, folder: Path = Path("studies")
) -> ThreadingHTTPServer:
    """The server of the bench on 127.0.0.1, not yet serving.

    Args:
        structure: the TOML description of the rig, saved with a design.
        port: to listen on; 0 for any free one.
        folder: where designs are saved as studies.

    Raises:
        StudyError: modes at points without positions, or a port that is not available.
    """
    content = {**setting(rig, units), "folder": str(folder)}
    template = Environment(autoescape=True, trim_blocks=True).from_string(asset("bench.html"))
    page = template.render(
        css=asset("page.css"),
        figures=asset("figure.js"),
        script=asset("bench.js"),
        setting=in_script(content),
        seen=DRAG.format(" from point to point" if isinstance(rig.modes.domain, NamedPoints) else ""),
    )
    handler = partial(_Handler, rig, structure, folder, page.encode())
    try:
        return _Server((HERE, port), handler)
    except (OSError, OverflowError) as error:
        raise StudyError(f"port {port} is not available ({error}); give another --port, or 0 for any") from error


class _Server(ThreadingHTTPServer):
    """A server with one thread per connection; a burst of connections waits instead of being refused."""

    request_queue_size, daemon_threads = MOST_WAITING, True

    def handle_error(self, request: socket | tuple[bytes, socket], client_address: object) -> None:
        """Print nothing about closed connections: only the command prints."""


class _Handler(BaseHTTPRequestHandler):
    """Answers requests of the bench's own page only; other Host and Origin headers are refused (DNS rebinding)."""

    server_version, sys_version, protocol_version = "workbench", "", "HTTP/1.1"
    timeout = CLIENT_SECONDS
    wbufsize, disable_nagle_algorithm = -1, True  # a response is sent whole and at once

    def __init__(self, rig: Rig, structure: str, folder: Path, page: bytes, *arguments: Any) -> None:
        self.rig, self.structure, self.folder, self.page = rig, structure, folder, page
        super().__init__(*arguments)

    def handle_one_request(self) -> None:
        """Handle one request within a time limit; that of a socket is per read, and single bytes never reach it."""
        self.late = Timer(CLIENT_SECONDS, self._drop)
        self.late.daemon = True
        self.late.start()
        try:
            super().handle_one_request()
        finally:
            self.late.cancel()

    def _drop(self) -> None:
        with suppress(OSError):  # already closed
            self.connection.shutdown(SHUT_RDWR)

    def do_GET(self) -> None:
        self.late.cancel()
        if not self._from_here():
            return self._answer(HTTPStatus.FORBIDDEN, {"error": "this bench answers 127.0.0.1 only"})
        if self.path != "/":
            return self._answer(HTTPStatus.NOT_FOUND, {"error": "there is nothing here"})
        self._send(HTTPStatus.OK, "text/html; charset=utf-8", self.page)

    def do_POST(self) -> None:
        if not self._from_here() or self.headers.get("Content-Type") != "application/json":
            return self._answer(HTTPStatus.FORBIDDEN, {"error": "this bench answers its own page only"})
        answers = {"/try": self._try, "/save": self._save}
        if self.path not in answers:
            return self._answer(HTTPStatus.NOT_FOUND, {"error": "there is nothing here"})
        try:
            answer = answers[self.path](self._content())
        except (ValueError, OSError, ArithmeticError) as error:
            self._answer(HTTPStatus.UNPROCESSABLE_ENTITY, {"error": str(error)})
        else:
            self._answer(HTTPStatus.OK, answer)

    def _try(self, content: dict[str, Any]) -> dict[str, Any]:
        return results_of(self.rig, design_from(content))

    def _save(self, content: dict[str, Any]) -> dict[str, Any]:
        if not isinstance(content, dict) or not isinstance(content.get("name"), str):
            raise StudyError("a design needs a name to be saved under")
        path = save(self.rig, self.structure, design_from(content.get("design", {})), content["name"], self.folder)
        return {"saved": str(path)}

    def _content(self) -> Any:
        length = self.headers.get("Content-Length", "")
        if not length.isdecimal() or int(length) > MOST_BYTES:
            self.close_connection = True
            raise StudyError(f"a request has at most {MOST_BYTES} bytes")
        try:
            content = self.rfile.read(int(length))
            self.late.cancel()
            return json.loads(content)
        except RecursionError:
            raise StudyError("the request is not a design") from None

    def _from_here(self) -> bool:
        port = self.connection.getsockname()[1]
        own = {f"{HERE}:{port}", f"localhost:{port}"}
        origin = self.headers.get("Origin")
        return self.headers.get("Host") in own and (origin is None or origin.removeprefix("http://") in own)

    def _answer(self, status: HTTPStatus, content: dict[str, Any]) -> None:
        if status in (HTTPStatus.FORBIDDEN, HTTPStatus.NOT_FOUND):
            self.close_connection = True  # the body of the request has not been read
        self._send(status, "application/json", json.dumps(content, allow_nan=False).encode())

    def _send(self, status: HTTPStatus, kind: str, body: bytes) -> None:
        self.send_response(status)
        for name, value in (
            ("Content-Type", kind),
            ("Content-Length", str(len(body))),
            ("Content-Security-Policy", POLICY),
            ("X-Content-Type-Options", "nosniff"),
            ("Cache-Control", "no-store"),
        ):
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *arguments: object) -> None:
        """Print nothing: only the command prints."""
