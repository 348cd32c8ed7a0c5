"""A local web page that shows pictures as they arrive."""

from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from threading import Condition, Thread
from typing import Any

import numpy as np

from tensorsim.errors import TensorsimError

_PAGE = b"""<!DOCTYPE html><html lang="en"><meta charset="utf-8"><title>tensorsim live</title>
<meta name="viewport" content="width=device-width, initial-scale=1">
<style>body{margin:0;background:#181c22}img{display:block;margin:auto;max-width:100%;max-height:100vh}</style>
<img src="/live.mjpg" alt="camera, Doppler-time map and labels"></html>"""


class LivePage:
    """Pictures as a stream of JPEGs (multipart/x-mixed-replace) at ``http://127.0.0.1:port/``."""

    def __init__(self) -> None:
        self.latest, self.count, self.ended = b"", 0, False
        self.changed = Condition()
        self.port = 0

    def show(self, picture: np.ndarray) -> None:
        """Show a picture (H, W, 3) uint8 RGB."""
        import cv2

        data = cv2.imencode(".jpg", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))[1].tobytes()
        with self.changed:
            self.latest, self.count = data, self.count + 1
            self.changed.notify_all()

    def pictures(self) -> Iterator[bytes]:
        """The newest picture whenever there is a new one; a slow reader misses some."""
        seen = 0
        while True:
            with self.changed:
                while self.count == seen and not self.ended:
                    self.changed.wait()
                if self.ended:
                    return
                data, seen = self.latest, self.count
            yield data


@contextmanager
def serving(port: int) -> Iterator[LivePage]:
    """A page that only this machine can open, at a port (0: any free one).

    Raises:
        TensorsimError: the port cannot be used.
    """
    page = LivePage()

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            # A web page whose host name resolves to this machine (DNS rebinding) could watch the camera.
            if self.headers.get("Host", "").split(":")[0] not in ("127.0.0.1", "localhost"):
                self.send_error(403)
            elif self.path == "/":
                self._answer("text/html; charset=utf-8", _PAGE)
            elif self.path == "/live.mjpg":
                self._stream()
            else:
                self.send_error(404)

        def _answer(self, kind: str, data: bytes) -> None:
            self.send_response(200)
            self.send_header("Content-Type", kind)
            self.send_header("Content-Length", str(len(data)))
            self.end_headers()
            self.wfile.write(data)

        def _stream(self) -> None:
            self.send_response(200)
            self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=frame")
            self.end_headers()
            try:
                for data in page.pictures():
                    self.wfile.write(b"--frame\r\nContent-Type: image/jpeg\r\n\r\n" + data + b"\r\n")
            except (BrokenPipeError, ConnectionResetError):
                pass  # the reader has gone

        def log_message(self, *_: Any) -> None:
            """Do not log requests."""

    try:
        server = ThreadingHTTPServer(("127.0.0.1", port), Handler)
    except OSError as error:
        raise TensorsimError(
            f"--port: {port} cannot be used ({error.strerror}), expected a free one"
        ) from None
    server.daemon_threads = True
    page.port = server.server_address[1]
    Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield page
    finally:
        with page.changed:
            page.ended = True
            page.changed.notify_all()
        server.shutdown()
        server.server_close()
