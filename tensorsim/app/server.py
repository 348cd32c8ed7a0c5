"""The server of the app: the page and the files of its runs."""

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from tensorsim.app.runs import Runs
from tensorsim.errors import TensorsimError

#: Hosts that only this machine can reach.
LOCAL = ("127.0.0.1", "localhost")


@contextmanager
def application(host: str, largest_mb: float, longest_s: float) -> Iterator[Any]:
    """The ASGI application; uploads and results are deleted when it closes.

    Args:
        host: address to serve. If it is local, requests for other host names are refused.
        largest_mb: size of the largest upload in megabytes.
        longest_s: longest film in seconds.

    Raises:
        TensorsimError: gradio is not installed.
    """
    with tempfile.TemporaryDirectory(prefix="tensorsim-app-") as scratch:
        # Gradio reads these on import: uploads go into the folder that is deleted, and no analytics are sent.
        os.environ["GRADIO_TEMP_DIR"] = str(Path(scratch) / "uploads")
        os.environ["GRADIO_ANALYTICS_ENABLED"] = "False"
        try:
            import gradio as gr
            from fastapi import FastAPI, HTTPException
            from fastapi.middleware.trustedhost import TrustedHostMiddleware
            from fastapi.responses import FileResponse
        except ImportError as error:
            raise TensorsimError(
                f'app: gradio cannot be imported ({error}); install it with: pip install "tensorsim[app]"'
            ) from None
        from tensorsim.app.page import CSS, build

        root = Path(scratch) / "runs"
        root.mkdir()
        runs = Runs(root)
        server = FastAPI(docs_url=None, redoc_url=None, openapi_url=None)
        if host in LOCAL:
            # A web page whose host name resolves to this machine (DNS rebinding) could read the app's answers.
            server.add_middleware(TrustedHostMiddleware, allowed_hosts=LOCAL)

        @server.get("/runs/{token}/{name}")
        def result(token: str, name: str) -> FileResponse:
            path = runs.file(token, name)
            if path is None:
                raise HTTPException(404)
            return FileResponse(path)

        page = build(runs, longest_s)
        # Otherwise Gradio, when mounted, accepts any path on this machine as an uploaded file.
        page.has_launched = True
        theme = gr.themes.Default(font=["system-ui", "sans-serif"], font_mono=["monospace"])
        mounted = gr.mount_gradio_app(
            server,
            page,
            path="/",
            server_name="127.0.0.1",
            max_file_size=round(largest_mb * 2**20),
            theme=theme,
            css=CSS,
            ssr_mode=False,
            footer_links=[],
        )
        try:
            yield mounted
        finally:
            runs.close()
