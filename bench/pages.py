"""What the pages cost: python -m bench.pages [--jobs 10000]

Bytes of the first page with all that it loads before anything is clicked, and the milliseconds (quickest, median) that
the server takes for each page with so many jobs in its list.
"""

import argparse
import re
import socket
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import httpx
import uvicorn
from fastapi import FastAPI

from bench.job_list import fill, measured
from trompe_experiments.markdown import markdown_table
from trompe_server.api.services import Services
from trompe_server.library import Library
from trompe_server.queue.store import JobStore
from trompe_server.service.app import create_app
from trompe_server.service.dispatch import prepare_data
from trompe_server.settings import Settings
from trompe_server.storage.folders import open_folder
from trompe_server.storage.tokens import Tokens

PATHS = ("/", "/jobs", "/jobs?state=failed", "/jobs?cursor=5000", "/jobs/new", "/experiments")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--jobs", type=int, default=10_000)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        settings = Settings(data=Path(folder), rate_limit=1e6)
        prepare_data(settings)
        store, files = JobStore(settings.database_url), open_folder(settings.store_url)
        fill(store, options.jobs)
        library = Library(files.within("library"))
        app = create_app(Services(settings, library, store, files, Tokens(store.engine), list, list))
        with served(app) as client:
            print(f"First page, with what it loads: {first_page(client) / 1000:.0f} kB\n")
            rows = [[path, *(f"{ms:.1f}" for ms in measured(partial(client.get, path))[:2])] for path in PATHS]
            print(markdown_table([f"{options.jobs:,} jobs", "quickest, ms", "median, ms"], rows))
        store.close()


@contextmanager
def served(app: FastAPI) -> Iterator[httpx.Client]:
    """A client of the application, over a real socket."""
    server = uvicorn.Server(uvicorn.Config(app, port=0, log_level="warning"))
    with socket.create_server(("127.0.0.1", 0)) as listener:
        listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)  # as `trompe serve` does
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]})
        thread.start()
        with httpx.Client(base_url=f"http://127.0.0.1:{listener.getsockname()[1]}", timeout=30) as client:
            yield client
        server.should_exit = True
        thread.join()


def first_page(client: httpx.Client) -> int:
    """Bytes of the start page, its style, its modules and the two pictures that its viewer shows first."""
    page = client.get("/").text
    found = [*re.findall(r'(?:href|src)="(/static/[^"]+)"', page), "/static/common.js"]
    shown = [f"/static/gallery/0/{kind}.png" for kind in ("before", "after")]
    answers = [client.get(path) for path in {*found, *shown}]
    assert all(answer.status_code == 200 for answer in answers)
    return len(page.encode()) + sum(len(answer.content) for answer in answers)


if __name__ == "__main__":
    main()
