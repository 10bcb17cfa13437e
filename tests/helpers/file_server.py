"""A server of files on this machine, which can be made to misbehave."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer


class Server(ThreadingHTTPServer):
    """Serves `files` (address -> bytes) and notes what was asked; `cut` and others make it misbehave."""

    def __init__(self, files: dict[str, bytes]):
        super().__init__(("127.0.0.1", 0), Handler)
        self.files, self.asked = files, []
        self.cut, self.ranges, self.endless, self.busy = 0, True, False, 0

    @property
    def address(self) -> str:
        return f"http://127.0.0.1:{self.server_port}"

    @contextmanager
    def serving(self) -> Iterator[None]:
        thread = threading.Thread(target=self.serve_forever, daemon=True)
        thread.start()
        try:
            yield
        finally:
            self.shutdown()
            self.server_close()
            thread.join()


class Handler(BaseHTTPRequestHandler):
    def log_message(self, *words) -> None:
        pass

    def do_GET(self) -> None:
        server, body = self.server, self.server.files.get(self.path.lstrip("/"))
        begin = int(self.headers.get("Range", "bytes=0-").split("=")[1].rstrip("-"))
        server.asked.append((self.path.rsplit("/", 1)[1], begin))
        if server.busy:
            server.busy -= 1
            self.send_error(503)
        elif body is None:
            self.send_error(404)
        else:
            begin = begin if server.ranges else 0
            self.send_response(206 if begin else 200)
            if not server.endless:
                self.send_header("Content-Length", str(len(body) - begin))
            self.end_headers()
            self.send(body[begin:])

    def send(self, body: bytes) -> None:
        if self.server.cut and len(body) > self.server.cut:
            body = body[: self.server.cut]
        try:
            self.wfile.write(body)
            while self.server.endless:
                self.wfile.write(bytes(2**16))
        except OSError:
            pass
