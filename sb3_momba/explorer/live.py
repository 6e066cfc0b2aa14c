"""`python -m sb3_momba.explorer live MODEL`: the decision kit as a page of this machine, on Python's own HTTP server.

The page asks nothing but this server, and the server answers nobody but the page: it listens on the loopback interface unless
told otherwise, refuses requests that come by a name it does not know (DNS rebinding) or from pages of others, reads JSON and
no files that a request names, and writes into one folder.
"""

import errno
import html
import ipaddress
import json
import logging
import os
import re
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import torch as th

from sb3_momba import __version__
from sb3_momba.explorer import charts
from sb3_momba.explorer.kit import DecisionKit, QuestionError
from sb3_momba.explorer.opening import open_kit
from sb3_momba.explorer.rendering import FPS
from sb3_momba.explorer.report import fill, film_numbers, json_in_html, page_file, plotly_script
from sb3_momba.files import no_link

HOST, PORT, LAST_PORT = "127.0.0.1", 8765, 65_535
LONGEST_REQUEST = 65_536  # bytes
SLOWEST_CLIENT = 30.0  # seconds
PAGE_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self' 'unsafe-inline'; img-src data: blob:; media-src blob:; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)

logger = logging.getLogger(__name__)

Content = tuple[str, bytes]  # type and bytes


class SupersededError(Exception):
    """A newer wish came before the turn of this one."""


class NewestFirst:
    """One thing at a time; of those that wait, only the newest gets its turn."""

    def __init__(self) -> None:
        self._turn, self._counting = threading.Lock(), threading.Lock()
        self._newest = 0

    @contextmanager
    def turn(self) -> Iterator[Callable[[], None]]:
        """Waits; gives a function that raises as soon as something newer waits.

        :raises SupersededError: if something newer came while this one waited
        """
        with self._counting:
            self._newest += 1
            mine = self._newest

        def still_wanted() -> None:
            if mine != self._newest:
                raise SupersededError

        with self._turn:
            still_wanted()
            yield still_wanted


class LiveServer(ThreadingHTTPServer):
    """Answers the page's questions about one kit.

    :param listening: of `listen`
    :param host: by which it listens
    """

    daemon_threads = True

    def __init__(self, kit: DecisionKit, listening: socket.socket, host: str = HOST):
        self.kit, self.rollouts = kit, NewestFirst()
        self.names = {host.lower(), "localhost"}
        self.files: dict[str, Content] = {
            "/": ("text/html; charset=utf-8", page_of(kit).encode()),
            "/live.css": ("text/css; charset=utf-8", (page_file("page.css") + page_file("live.css")).encode()),
            "/live.js": ("text/javascript; charset=utf-8", (page_file("common.js") + page_file("live.js")).encode()),
            "/plotly.js": ("text/javascript; charset=utf-8", plotly_script().encode()),
        }
        self.actions: dict[str, Callable[[dict[str, Any]], dict[str, Any]]] = {
            "/predict": lambda asked: kit.predict(kit.check(asked.get("preference"))),
            "/around": lambda asked: kit.around(kit.check(asked.get("preference"))),
            "/rollout": self._rollout,
            "/film": self._film,
            "/bound": self._bound,
            "/keep": lambda asked: kit.keep(kit.check(asked.get("preference"))),
        }
        super().__init__(listening.getsockname()[:2], Handler, bind_and_activate=False)
        self.socket.close()
        self.socket = listening

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A page that was closed before its answer came is no news."""
        if not isinstance(sys.exc_info()[1], ConnectionError | TimeoutError):
            super().handle_error(request, client_address)

    @property
    def url(self) -> str:
        """Where the page is."""
        host, port = self.socket.getsockname()[:2]
        return f"http://[{host}]:{port}/" if ":" in host else f"http://{host}:{port}/"

    def is_known(self, host: str) -> bool:
        """Whether a Host header names this server: an address, which no one else's name can turn into, or a known name."""
        name = host.rsplit(":", 1)[0] if not host.endswith("]") else host
        try:
            ipaddress.ip_address(name.strip("[]"))
            return True
        except ValueError:
            return name.lower() in self.names

    def _rollout(self, asked: dict[str, Any]) -> dict[str, Any]:
        preference = self.kit.check(asked.get("preference"))
        with self.rollouts.turn():
            return self.kit.show_rollout(preference)

    def _film(self, asked: dict[str, Any]) -> dict[str, Any]:
        preference = self.kit.check(asked.get("preference"))
        with self.rollouts.turn():
            return {"preference": preference.tolist(), **film_numbers(self.kit.show_film(preference))}

    def _bound(self, asked: dict[str, Any]) -> dict[str, Any]:
        preference, objective = self.kit.check(asked.get("preference")), asked.get("objective")
        if type(objective) is not int or not 0 <= objective < len(self.kit.objectives):
            raise QuestionError(f"objective is {objective!r}: give a number from 0 to {len(self.kit.objectives) - 1}.")
        given = {name: number_of(asked[name], name) for name in ("at_least", "less") if name in asked}
        if len(given) != 1:
            raise QuestionError("Give one of at_least and less.")
        with self.rollouts.turn() as still_wanted:
            return self.kit.meet(preference, objective, **given, still_wanted=still_wanted)


def number_of(x: Any, name: str) -> float:
    """:raises QuestionError: for what is no finite number, or a negative `less`"""
    if isinstance(x, bool) or not isinstance(x, int | float) or not abs(x) < 1e300:
        raise QuestionError(f"{name} is {x!r}: give a number.")
    if name == "less" and x < 0:
        raise QuestionError(f"less is {x}: give 0 or more.")
    return float(x)


class Handler(BaseHTTPRequestHandler):
    """One request."""

    server: LiveServer
    server_version, sys_version = "sb3-momba", ""
    protocol_version = "HTTP/1.1"
    timeout = SLOWEST_CLIENT
    disable_nagle_algorithm = True  # Headers and content are two packets, and the second one would wait for 40 ms.

    def do_GET(self) -> None:
        """The page and its files, by their names alone."""
        content = self.server.files.get(self.path)
        if not self._is_trusted():
            self._refuse(HTTPStatus.FORBIDDEN, "This server is not known by that name: open it by its address.")
        elif content is None:
            self._refuse(HTTPStatus.NOT_FOUND, "There is no such page.")
        else:
            self._send(HTTPStatus.OK, *content)

    def do_POST(self) -> None:
        """A question: JSON for JSON."""
        body = self._body()
        if body is None:
            return
        action = self.server.actions.get(self.path)
        if action is None:
            self._refuse(HTTPStatus.NOT_FOUND, "There is no such action.")
            return
        try:
            answer = self._answer(action, body)
        except QuestionError as error:
            self._refuse(HTTPStatus.BAD_REQUEST, str(error))
        except Exception as error:  # Environments raise what they like, and the page must hear of it.
            logger.exception("%s failed.", self.path)
            self._refuse(HTTPStatus.INTERNAL_SERVER_ERROR, f"{type(error).__name__}: {error}")
        else:
            self._send(HTTPStatus.OK, "application/json", answer)

    def _answer(self, action: Callable[[dict[str, Any]], dict[str, Any]], body: bytes) -> bytes:
        start = time.perf_counter()
        try:
            asked = json.loads(body)
        except (ValueError, RecursionError) as error:
            raise QuestionError(f"The request is no JSON: {error}") from error
        if not isinstance(asked, dict):
            raise QuestionError("The request is no JSON object.")
        try:
            answer = action(asked)
        except SupersededError:  # No error: browsers would log one.
            answer = {"superseded": True}
        return json.dumps({**answer, "seconds": time.perf_counter() - start}, allow_nan=False).encode()

    def _body(self) -> bytes | None:
        """Of a request that may be answered; the others are refused here."""
        length = self.headers.get("Content-Length", "")
        if not re.fullmatch("[0-9]{1,9}", length) or int(length) > LONGEST_REQUEST:
            self.close_connection = True  # Its body is not read.
            self._refuse(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, f"A request has at most {LONGEST_REQUEST} bytes.")
            return None
        body = self.rfile.read(int(length))
        if not self._is_trusted():
            self._refuse(HTTPStatus.FORBIDDEN, "This server answers its own page only.")
        elif self.headers.get_content_type() != "application/json":
            self._refuse(HTTPStatus.UNSUPPORTED_MEDIA_TYPE, "Requests are JSON: Content-Type: application/json.")
        else:
            return body
        return None

    def _is_trusted(self) -> bool:
        host, origin = self.headers.get("Host", ""), self.headers.get("Origin")
        return self.server.is_known(host) and origin in (None, f"http://{host}")

    def _refuse(self, status: HTTPStatus, why: str) -> None:
        self._send(status, "application/json", json.dumps({"error": why}).encode())

    def _send(self, status: HTTPStatus, kind: str, content: bytes) -> None:
        self.send_response(status)
        headers = {
            "Content-Type": kind,
            "Content-Length": str(len(content)),
            "Cache-Control": "no-store",
            "Content-Security-Policy": PAGE_POLICY,
            "X-Content-Type-Options": "nosniff",
            "Referrer-Policy": "no-referrer",
        }
        for name, value in headers.items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(content)

    def log_message(self, format: str, *args: Any) -> None:
        """Nothing: requests are many, and no news."""


def page_of(kit: DecisionKit) -> str:
    """The page, with what it must know from the start."""
    front = charts.front([kit.as_run()], kit.objectives, "discounted return")
    for trace in front["data"]:
        trace["name"] = "evaluated"
    for name, symbol, dash in (("predicted", "circle-open", "dot"), ("rollout", "diamond-open", "solid")):
        mark = charts.selection(len(kit.objectives))
        line = {**mark["line"], "dash": dash}
        front["data"].append(
            {**mark, "name": name, "showlegend": True, "line": line, "marker": {**mark["marker"], "symbol": symbol}}
        )
    front["layout"]["showlegend"] = True
    front["layout"]["legend"]["itemsizing"] = "constant"
    numbers = {
        "objectives": kit.objectives,
        "preferences": kit.front.preferences.tolist(),
        "ranges": charts.ranges_of([kit.measured]).tolist(),
        "start": [1 / len(kit.objectives)] * len(kit.objectives),
        "front": front,
        "fps": FPS,
        "noFilm": kit.no_film,
    }
    named = ", ".join(kit.objectives[:-1]) + f" and {kit.objectives[-1]}"
    parts = {
        "title": html.escape(kit.run.record.task),
        "model": html.escape(str(kit.run.policy.path)),
        "objectives": html.escape(named),
        "predictor": html.escape(kit.about_prediction()),
        "folder": html.escape(str(kit.folder)),
        "version": html.escape(__version__),
        "data": json_in_html(numbers),
    }
    return fill(page_file("live.html"), parts)


def serve(
    path: Path,
    env: str | None = None,
    seeds: Sequence[Path] = (),
    folder: Path | None = None,
    host: str = HOST,
    port: int = PORT,
) -> None:
    """Serve the decision kit of a model until Ctrl-C; see `open_kit` and `listen`."""
    plotly_script()  # What is missing is said before anything is rolled out, and where nothing may be written.
    folder = folder or no_link((path if path.is_dir() else path.parent) / "kept", "--keep")
    if not is_loopback(host):
        logger.warning("Warning: --host %s lets everyone who reaches this machine roll out and keep policies.", host)
    th.set_num_threads(1)  # More of them only slow such small products down.
    with listen(host, port) as listening, open_kit(path, env, seeds, folder) as kit, LiveServer(kit, listening, host) as server:
        logger.info("Open %s in a browser; Ctrl-C ends it.", server.url)
        server.serve_forever()


def listen(host: str, port: int) -> socket.socket:
    """
    :param host: a name or an address
    :param port: 0 takes a free one
    :raises ValueError: for a number that is no port
    :raises OSError: if it is in use, or cannot be had
    """
    if not 0 <= port <= LAST_PORT:
        raise ValueError(f"--port {port}: give a number from 1 to {LAST_PORT}, or 0 for a free port.")
    try:
        socket.getaddrinfo(host, port)
    except socket.gaierror as error:
        raise OSError(f"--host {host} is no name or address that is known here ({error.strerror}).") from error
    try:
        return socket.create_server((host, port), family=socket.AF_INET6 if ":" in host else socket.AF_INET)
    except OSError as error:
        if error.errno == errno.EADDRNOTAVAIL:
            raise OSError(f"--host {host} is no address of this machine.") from error
        why = os.strerror(error.errno) if error.errno else error  # Its own text has the address once more.
        raise OSError(f"{host}:{port} cannot be listened on ({why}): try --port 0.") from error


def is_loopback(host: str) -> bool:
    """Whether only this machine can reach an address."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host.lower() == "localhost"
