"""``tensorsim app``: the simulation in a browser."""

import socket
import sys
from dataclasses import dataclass

from tensorsim.exceptions import TensorsimError


@dataclass(frozen=True)
class App:
    """Start the web app: upload a film or choose an activity, set parameters and view the results.

    Needs gradio: pip install "tensorsim[app]". Only this machine can reach the page unless --host says otherwise.
    """

    host: str = "127.0.0.1"
    """Address to listen on."""
    port: int = 7860
    """Port to listen on."""
    largest_mb: float = 200.0
    """Maximum size of a film in megabytes."""
    longest_s: float = 60.0
    """Maximum duration of a film in seconds."""

    def run(self) -> None:
        """Run the command."""
        if not 1 <= self.port < 65536:
            raise TensorsimError(f"--port: got {self.port}, expected a number from 1 to 65535")
        for name, value in (("largest-mb", self.largest_mb), ("longest-s", self.longest_s)):
            if not 0 < value < float("inf"):
                raise TensorsimError(f"--{name}: got {value}, expected a positive number")
        from tensorsim.app.server import application

        with (
            _listening(self.host, self.port) as bound,
            application(self.host, self.largest_mb, self.longest_s) as app,
        ):
            import uvicorn

            print(f"tensorsim: http://{self.host}:{self.port}/ (Ctrl-C ends)", file=sys.stderr)
            # An open page keeps its connection; when it is closed, Uvicorn would log an error with a traceback.
            config = uvicorn.Config(app, log_level="critical", timeout_graceful_shutdown=1)
            uvicorn.Server(config).run([bound])


def _listening(host: str, port: int) -> socket.socket:
    """A socket at this address; if Uvicorn opened it, a failure would end the process."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        return socket.create_server((host, port), family=family)
    except OSError as error:
        reason = (error.strerror or str(error)).split(" (")[0]  # without the address again
        raise TensorsimError(
            f"--host, --port: {host}, {port} cannot be used ({reason}), expected an address of this machine "
            "and a free port"
        ) from None
