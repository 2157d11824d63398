"""The tap's page for browsers: one page and one stream of events, with the standard library.

The server only answers GET requests for ``/`` and ``/events``, and reads no file. The server refuses requests from
other sites (Host, Origin, Sec-Fetch-Site), so that a page on the Internet cannot read the data by DNS rebinding. Every
request needs the token of the printed address, because all users of a machine share the loopback. The first visit with
the token sets a cookie, which then replaces the token.

Each browser has a thread that only reads the :class:`~aerpaw_cmp.live.feed.Feed`. A browser that does not read for some
seconds is disconnected. When it comes back, it gets the data that it missed. The tap never waits for a browser.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import hmac
import io
import ipaddress
import json
import re
import secrets
import selectors
import socket
import threading
import time
from dataclasses import dataclass
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import parse_qs, quote, urlsplit

from ..common.errors import UsageError
from .feed import Feed

DEFAULT = "127.0.0.1:8765"
_ADDRESS = re.compile(r"(\[[0-9A-Fa-f:.]+\]|[A-Za-z0-9.-]*):([0-9]{1,5})")
# Number of bytes that are written to a browser's socket at a time. The time limit applies to each piece, so that a slow
# connection is not mistaken for a broken connection.
_PIECE = 16_384
# Largest number of connections, from all addresses, whose request is not complete.
_MOST_WAITING = 256
_TOKEN_WANTED = "the token is missing or wrong: use the address that the tap printed"
_NO_TOKEN = f"HTTP/1.0 403 Forbidden\r\nContent-Type: text/plain\r\n\r\n{_TOKEN_WANTED}\n".encode()


@dataclass(frozen=True, slots=True)
class Page:
    """The page that is served: its bytes and its Content-Security-Policy."""

    body: bytes
    policy: str

    @property
    def digest(self) -> str:
        """The identity of the page. A browser that shows another version reloads the page."""
        return hashlib.sha256(self.body).hexdigest()[:16]


@dataclass(frozen=True, slots=True)
class Limits:
    """The limits for browsers.

    Parameters
    ----------
    connections : int
        Largest number of connections of browsers with the token.
    request_s : float
        Longest time between a connection and the end of its request [s].
    send_s : float
        Time after which a browser that does not read is disconnected [s].
    tick_s : float
        Interval at which the tap's queue is processed, and between messages to one browser [s].
    """

    connections: int = 24
    request_s: float = 5.0
    send_s: float = 5.0
    tick_s: float = 0.1


@dataclass(frozen=True, slots=True)
class Address:
    """Host and port at which the page is served."""

    host: str
    port: int

    @classmethod
    def parse(cls, text: str) -> Address:
        """Parse the address ``HOST:PORT``. An empty host means the loopback.

        Raises
        ------
        UsageError
            If the text is not an address.

        Examples
        --------
        >>> Address.parse("0.0.0.0:8765").loopback, Address.parse("[::1]:80").loopback
        (False, True)
        """
        match = _ADDRESS.fullmatch(text)
        if match is None or not 0 <= int(match[2]) < 65_536:
            raise UsageError(f"--web {text!r}", expected=f"HOST:PORT, e.g. {DEFAULT} or 0.0.0.0:8765")
        return cls(match[1].strip("[]") or "127.0.0.1", int(match[2]))

    @property
    def loopback(self) -> bool:
        """True if only this computer can reach the address."""
        return _is_loopback(self.host)

    def __str__(self) -> str:
        return f"[{self.host}]:{self.port}" if ":" in self.host else f"{self.host}:{self.port}"


class WebServer(ThreadingHTTPServer):
    """A server for the page of a feed, used as a context. Browsers with the token have a thread each.

    All connections wait in one loop until their requests are complete, for a limited time. The loop refuses requests
    without the token, so they do not need threads. If too many connections wait, connections of the most frequent
    address are closed, so that a flood blocks only its own address.

    Parameters
    ----------
    feed : Feed
    page : Page
    address : Address
    token : str, optional
        The token that the URL must contain. A token that the user sets is secret and is not printed. If it is None or
        empty, a random token is used.
    limits : Limits

    Raises
    ------
    UsageError
        If the address cannot be used.
    """

    daemon_threads = True
    block_on_close = False
    # the default of 5 would refuse browsers during a flood
    request_queue_size = 128

    def __init__(
        self, feed: Feed, page: Page, address: Address, *, token: str | None = None, limits: Limits | None = None
    ) -> None:
        self.feed, self.page, self.limits = feed, page, limits or Limits()
        self._printed = not token
        self.token = token or secrets.token_urlsafe(12)
        # The cookie is not the token itself, and its path is known only to this server: a browser sends cookies of
        # 127.0.0.1 to every port of this computer, and another user may listen on one of these ports.
        self.pass_word = hmac.new(self.token.encode(), b"cookie", "sha256").hexdigest()
        self.base = f"/{hmac.new(self.token.encode(), b'path', 'sha256').hexdigest()[:32]}/"
        self._secrets = quote(self.token).encode(), self.pass_word.encode()
        self.closing = self._ended = False
        self._lock = threading.Lock()
        self.waiting: dict[socket.socket, _Waiting] = {}
        self.heads: dict[socket.socket, bytes] = {}
        self.browsers: set[socket.socket] = set()
        self.address_family = socket.AF_INET6 if ":" in address.host else socket.AF_INET
        try:
            super().__init__((address.host, address.port), _Handler)
        except OSError as error:
            raise _refused(address, error) from None
        self.address = Address(address.host, self.server_address[1])
        self._thread = threading.Thread(target=self._serve, name="tap-web", daemon=True)

    def __enter__(self) -> WebServer:
        self._thread.start()
        threading.Thread(target=self._digest, name="tap-web-feed", daemon=True).start()
        return self

    def __exit__(self, *exc: object) -> None:
        """Wait a moment until browsers have the latest data, and close the server."""
        self.feed.digest()
        self.closing = True
        until = time.monotonic() + 1.5
        while self.browsers and time.monotonic() < until:
            time.sleep(0.02)
        self._ended = True
        self._thread.join()
        self.server_close()
        for request in list(self.browsers):
            with contextlib.suppress(OSError):
                request.shutdown(socket.SHUT_RDWR)

    @property
    def urls(self) -> list[str]:
        """The addresses for a browser. For all interfaces, the address that other computers see comes first."""
        query = f"/?token={quote(self.token) if self._printed else '...'}"
        hosts = [self.address.host]
        if self.address.host in ("0.0.0.0", "::"):
            hosts = [*_outward(), "127.0.0.1"]
        return [f"http://{Address(host, self.address.port)}{query}" for host in hosts]

    def _digest(self) -> None:
        while not self.closing:
            self.feed.digest()
            time.sleep(self.limits.tick_s)

    def server_bind(self) -> None:
        """Bind without looking up the name of this computer. The look-up may need the network."""
        self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        self.socket.bind(self.server_address)
        self.server_address = self.socket.getsockname()

    def _serve(self) -> None:
        """Accept connections and read their requests."""
        self.socket.setblocking(False)
        with selectors.DefaultSelector() as ready:
            ready.register(self.socket, selectors.EVENT_READ)
            while not self._ended:
                for key, _ in ready.select(self.limits.tick_s):
                    self._accept(ready) if key.fileobj is self.socket else self._read(key.fileobj, ready)
                limit = time.monotonic() - self.limits.request_s
                for request in [request for request, waiting in self.waiting.items() if waiting.since_s < limit]:
                    self._leave(request, ready)
                    request.close()
        for request in self.waiting:
            request.close()

    def _accept(self, ready: selectors.BaseSelector) -> None:
        """Accept a connection, which then waits for its request.

        If too many connections wait, close the oldest connection from the address with the most connections.
        """
        try:
            request, address = self.socket.accept()
        except OSError:  # the listening socket is closed, or too many files are open
            time.sleep(0.01)
            return
        request.setblocking(False)
        self.waiting[request] = _Waiting(address, time.monotonic())
        ready.register(request, selectors.EVENT_READ)
        if len(self.waiting) > _MOST_WAITING:
            hosts = [waiting.address[0] for waiting in self.waiting.values()]
            crowding = list(self.waiting)[hosts.index(max(set(hosts), key=hosts.count))]
            self._leave(crowding, ready)
            crowding.close()

    def _leave(self, request: socket.socket, ready: selectors.BaseSelector) -> None:
        ready.unregister(request)
        del self.waiting[request]

    def _read(self, request: Any, ready: selectors.BaseSelector) -> None:
        """Read a part of a request. Pass a complete request with the token to a thread. Refuse all other requests."""
        if request not in self.waiting:
            return  # the request was closed earlier in this loop
        waiting, data = self.waiting[request], b""
        with contextlib.suppress(OSError):
            data = request.recv(_PIECE)
        waiting.head += data
        if data and b"\r\n\r\n" not in waiting.head and len(waiting.head) < _PIECE:
            return  # a browser may send its header in pieces
        self._leave(request, ready)
        with contextlib.suppress(OSError, RuntimeError):  # the client has left, or no thread can be started
            # the handler verifies the token
            if any(secret in waiting.head for secret in self._secrets):
                self.heads[request] = waiting.head
                request.setblocking(True)
                self.process_request(request, waiting.address)
                return
            request.send(_NO_TOKEN)
        request.close()

    def shutdown_request(self, request: Any) -> None:
        """Forget the connection, then close it."""
        with self._lock:
            self.browsers.discard(request)
        self.heads.pop(request, None)
        super().shutdown_request(request)

    def let_in(self, request: Any) -> bool:
        """Register a connection with the token. Return False if too many connections with the token are open."""
        with self._lock:
            if len(self.browsers) >= self.limits.connections:
                return False
            self.browsers.add(request)
            return True

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Do not print anything: a disconnecting browser is not an error, and the terminal shows the tap's status."""


@dataclass(slots=True)
class _Waiting:
    """A connection whose request is not complete."""

    address: tuple[Any, ...]
    since_s: float
    head: bytes = b""


class _Handler(BaseHTTPRequestHandler):
    """A request handler with HTTP/1.0, so that each connection ends with its answer."""

    server: WebServer
    server_version = "aerpaw-cmp"
    sys_version = ""

    def setup(self) -> None:
        super().setup()
        self.rfile = io.BytesIO(self.server.heads.pop(self.request))
        self.connection.settimeout(self.server.limits.send_s)
        # use a small kernel buffer, to notice earlier that a browser does not read
        self.connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 8 * _PIECE)

    def do_GET(self) -> None:
        """Answer with the page or the events."""
        try:
            parts = urlsplit(self.path)
            query = {name: values[0] for name, values in parse_qs(parts.query, max_num_fields=8).items()}
        except ValueError:
            self.send_error(HTTPStatus.BAD_REQUEST)
            return
        base = self.server.base
        private = parts.path.startswith(base)
        path = f"/{parts.path[len(base) :]}" if private else parts.path
        refusal = self._refusal(path, query, private)
        if refusal is not None:
            self._text(*refusal)
        elif not self.server.let_in(self.request):
            self._text(HTTPStatus.SERVICE_UNAVAILABLE, "too many browsers have this page open")
        elif path == "/" and not private:
            self.send_response(HTTPStatus.SEE_OTHER)
            self.send_header("Location", f"{base}?{parts.query}")
            self.end_headers()
        elif path == "/":
            body = self.server.page.body
            self._head("text/html; charset=utf-8", len(body), cookie=True)
            self._pieces(body)
        else:
            self._head("text/event-stream", None)
            self._events(self.headers.get("Last-Event-ID") or query.get("from", ""))

    def _refusal(self, path: str, query: dict[str, str], private: bool) -> tuple[HTTPStatus, str] | None:
        """Return status and reason with which the request is refused, None if the request is answered."""
        web, headers = self.server, self.headers
        hosts, origins = headers.get_all("Host", []), headers.get_all("Origin", [])
        if len(hosts) != 1 or not _own_host(hosts[0], web.address.loopback):
            return HTTPStatus.FORBIDDEN, "the Host is not a name of this computer"
        if any(origin.lower() != f"http://{hosts[0]}".lower() for origin in origins):
            return HTTPStatus.FORBIDDEN, "the request comes from another site"
        opened = path == "/" and headers.get("Sec-Fetch-Dest", "document") == "document"
        if headers.get("Sec-Fetch-Site", "none") not in ("none", "same-origin") and not opened:
            return HTTPStatus.FORBIDDEN, "the request comes from another site"
        if not self._has_token(query, private):
            return HTTPStatus.FORBIDDEN, _TOKEN_WANTED
        if path not in ("/", "/events"):
            return HTTPStatus.NOT_FOUND, "there is one page here: /"
        return None

    @property
    def _cookie(self) -> str:
        return f"aerpaw_tap_{self.server.address.port}"

    def _has_token(self, query: dict[str, str], private: bool) -> bool:
        """Check whether a request has the token in its address or, below the private path, the cookie."""
        pairs = (item.strip().partition("=") for item in self.headers.get("Cookie", "").split(";"))
        cookie = next((value for name, _, value in pairs if private and name == self._cookie), "")
        # compare in constant time: the duration of a refusal must not show how much of the token was right
        given = (query.get("token", ""), self.server.token), (cookie, self.server.pass_word)
        return any(hmac.compare_digest(text.encode(), secret.encode()) for text, secret in given)

    def _events(self, cursor: str) -> None:
        """Send new data until the browser leaves or stops reading, or the session ends."""
        web, page = self.server, self.server.page.digest
        self._pieces(b"retry: 1000\n\n")
        while True:
            message, cursor = web.feed.after(cursor, 0.0 if web.closing else 1.0)
            if message is None and web.closing:
                return
            text = ":\n\n"
            if message is not None:
                content = json.dumps({**message, "page": page}, separators=(",", ":"), allow_nan=False)
                text = f"id: {cursor}\ndata: {content}\n\n"
            self._pieces(text.encode("ascii"))
            time.sleep(0.0 if web.closing else web.limits.tick_s)

    def _head(self, kind: str, length: int | None, status: HTTPStatus = HTTPStatus.OK, *, cookie: bool = False) -> None:
        self.send_response(status)
        self.send_header("Content-Type", kind)
        if cookie:
            secret = self.server.pass_word
            self.send_header(
                "Set-Cookie", f"{self._cookie}={secret}; Path={self.server.base}; HttpOnly; SameSite=Strict"
            )
        if length is not None:
            self.send_header("Content-Length", str(length))
        self.end_headers()

    def end_headers(self) -> None:
        """End the head of an answer with the headers that every answer has."""
        for name, value in (
            ("Content-Security-Policy", self.server.page.policy),
            ("X-Content-Type-Options", "nosniff"),
            ("Referrer-Policy", "no-referrer"),
            ("Cross-Origin-Resource-Policy", "same-origin"),
            ("Cross-Origin-Opener-Policy", "same-origin"),
            ("Cache-Control", "no-store"),
            ("Connection", "close"),
        ):
            self.send_header(name, value)
        super().end_headers()

    def send_error(self, code: int, message: str | None = None, explain: str | None = None) -> None:  # noqa: ARG002
        """Answer requests that http.server refuses. The answer does not repeat any part of the request."""
        self._text(HTTPStatus(code), HTTPStatus(code).phrase)

    def _text(self, status: HTTPStatus, text: str) -> None:
        body = f"{text}\n".encode()
        self._head("text/plain; charset=utf-8", len(body), status)
        self._pieces(body)

    def _pieces(self, data: bytes) -> None:
        for start in range(0, len(data), _PIECE):
            self.wfile.write(data[start : start + _PIECE])

    def log_message(self, format: str, *args: Any) -> None:
        """Do not print anything, because the tap shows its status on the terminal."""


def _is_loopback(host: str) -> bool:
    if host.lower() == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def _own_host(text: str, loopback: bool) -> bool:
    """Check whether a Host header names this computer by address or host name.

    The port in the header may be that of a tunnel.
    """
    match = re.fullmatch(r"(\[[0-9A-Fa-f:.]+\]|[A-Za-z0-9.-]+)(:[0-9]{1,5})?", text)
    if match is None:
        return False
    host = match[1].strip("[]").lower()
    if loopback or _is_loopback(host):
        return _is_loopback(host)
    own = socket.gethostname().lower()
    try:
        ipaddress.ip_address(host)
    except ValueError:
        return host in (own, f"{own.split('.')[0]}.local")
    return True  # DNS cannot redirect a numeric address


def _outward() -> list[str]:
    """Return the address of this computer that other computers see, without sending a packet."""
    with contextlib.suppress(OSError), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.connect(("192.0.2.1", 9))  # TEST-NET-1: a route is looked up, but no packet is sent
        return [str(probe.getsockname()[0])]
    return []


def _refused(address: Address, error: OSError) -> UsageError:
    """Return the error for an address that cannot be used."""
    cause = {
        errno.EADDRINUSE: "another tap or another server uses this port",
        errno.EACCES: "ports below 1024 require administrator rights",
        errno.EADDRNOTAVAIL: "this computer has no such address",
    }.get(error.errno or 0, "the name of another computer")
    taken = error.errno == errno.EADDRINUSE
    expected = "a free port; 0 selects one" if taken else f"an address of this computer, e.g. {DEFAULT}"
    return UsageError(f"--web {address}: {error.strerror}", expected=expected, cause=cause)
