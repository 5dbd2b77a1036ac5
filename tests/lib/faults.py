"""A proxy before an S3 server on this machine that lets requests fail, and this server (moto's), for tests.

    server = subprocess.Popen([sys.executable, faults.__file__, PORT_FILE])

starts moto's server in a process of its own, on a free port that it writes into PORT_FILE.
"""

import http.client
import http.server
import random
import socketserver
import sys
import threading
import time
from pathlib import Path

KINDS = ("refused", "throttled", "failed", "cut before", "cut after", "cut answer", "late")
LATE = 0.6  # seconds that an answer is late; tests give up sooner


class Proxy(socketserver.ThreadingMixIn, http.server.HTTPServer):
    """Forwards requests to a server, and breaks a fraction `rate` of them in one of `kinds`; `injected` counts these.

    "cut before" closes the connection before the server gets the request, "cut after" when it has done the work.
    """

    daemon_threads = True
    request_queue_size = 128

    def __init__(self, port, rate, seed=1, kinds=KINDS):
        super().__init__(("127.0.0.1", 0), Handler)
        self.port, self.rate, self.kinds, self.random = port, rate, kinds, random.Random(seed)
        self.injected, self.requests, self.guard = dict.fromkeys(KINDS, 0), 0, threading.Lock()
        threading.Thread(target=self.serve_forever, daemon=True, args=(0.05,)).start()

    @property
    def url(self):
        return f"http://127.0.0.1:{self.server_address[1]}"

    def fault(self):
        with self.guard:
            self.requests += 1
            kind = self.random.choice(self.kinds) if self.random.random() < self.rate else None
            if kind:
                self.injected[kind] += 1
        return kind

    def handle_error(self, request, client_address):
        """A client that gave up is what the tests want."""


class Handler(http.server.BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"

    def log_message(self, *_):
        pass

    def forward(self):
        kind, body = self.server.fault(), self.rfile.read(int(self.headers.get("Content-Length", 0)))
        if kind in ("refused", "throttled", "failed"):
            return self.answer({"refused": 503, "throttled": 429, "failed": 500}[kind], [], b"<Error/>")
        if kind == "cut before":
            return self.cut()
        connection = http.client.HTTPConnection("127.0.0.1", self.server.port, timeout=60)
        headers = {key: x for key, x in self.headers.items() if key.lower() not in ("connection", "host")}
        connection.request(self.command, self.path, body, headers | {"Host": self.headers["Host"]})
        response = connection.getresponse()
        data, length = response.read(), response.getheader("Content-Length")
        connection.close()
        if kind == "late":
            time.sleep(LATE)
        if kind == "cut after":
            return self.cut()
        skipped = ("content-length", "transfer-encoding", "connection", "date", "server")
        kept = [(key, x) for key, x in response.getheaders() if key.lower() not in skipped]
        return self.answer(response.status, kept, data, length if self.command == "HEAD" else None, kind)

    def answer(self, status, headers, data, length=None, kind=None):
        self.send_response(status)
        for key, value in headers:
            self.send_header(key, value)
        self.send_header("Content-Length", length or str(len(data)))
        self.end_headers()
        if kind == "cut answer" and self.command != "HEAD":
            self.wfile.write(data[: len(data) // 2])
            return self.cut()
        if self.command != "HEAD":
            self.wfile.write(data)
        return None

    def cut(self):
        self.close_connection = True
        self.wfile.flush()
        self.connection.close()

    do_GET = do_PUT = do_POST = do_DELETE = do_HEAD = forward  # noqa: N815


def serve(port_file):
    """moto's server, until this process is ended."""
    import logging

    from moto.server import DomainDispatcherApplication, create_backend_app
    from werkzeug.serving import make_server

    logging.getLogger("werkzeug").setLevel(logging.ERROR)
    server = make_server("127.0.0.1", 0, DomainDispatcherApplication(create_backend_app), threaded=True)
    Path(port_file + ".partial").write_text(str(server.server_port))
    Path(port_file + ".partial").rename(port_file)
    server.serve_forever()


if __name__ == "__main__":
    serve(sys.argv[1])
