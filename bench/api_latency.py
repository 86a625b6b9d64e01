"""How fast the API answers while attack workers compute on all cores.

    python -m bench.api_latency [--seconds 60] [--rate 50] [--workers 2] [--submits 0.2]

Starts `trompe serve` on a new folder, gives each attack worker a long real attack (the shipped mug, the shipped
classifier), and sends requests at a fixed rate, whether or not the ones before were answered: so a server that stalls
is measured as a client would feel it. Reads are single jobs, pages of 50 jobs, workers and objects, in turn.
"""

import argparse
import asyncio
import os
import statistics
import time
from collections.abc import Mapping, Sequence
from typing import Any

import httpx

from bench._common import machine
from trompe_client._embedded import SERVE, embedded_server
from trompe_experiments.markdown import markdown_table
from trompe_shared.api import JobRequest

MARKS = {"reads": 0.050, "submits": 0.150}
"""Seconds that 99 of 100 must be answered in."""
LONG = {"steps": 10_000, "epsilon": 0.004, "alpha": 0.0002, "priority": "interactive"}
QUEUED = {"needs": {"gpu": 1}, "labels": {"bench": "latency"}}
"""What is submitted stays in the queue: there is no worker with a GPU."""


def mug(options: Mapping[str, Any], seed: int) -> dict[str, Any]:
    """A job on the shipped mug."""
    return JobRequest.of("mug", label="mug", seed=seed, **options).model_dump(mode="json")


async def occupy(client: httpx.AsyncClient, workers: int) -> None:
    """Give each worker an attack, and wait until all of them are at its steps."""
    for seed in range(workers):
        (await client.post("/v1/jobs", json=mug(LONG, seed))).raise_for_status()
    while True:
        running = (await client.get("/v1/jobs", params={"state": "running"})).json()["jobs"]
        phases = [job["progress"]["phase"] for job in running]
        if len(phases) == workers and all(phase.startswith("attack") for phase in phases):
            return
        await asyncio.sleep(1)


async def fill(client: httpx.AsyncClient, count: int) -> list[str]:
    """Ids of jobs that reads ask for."""
    answers = [await client.post("/v1/jobs", json=mug(QUEUED, seed)) for seed in range(count)]
    return [answer.raise_for_status().json()["id"] for answer in answers]


async def measure(
    client: httpx.AsyncClient, jobs: Sequence[str], options: argparse.Namespace
) -> dict[str, list[float]]:
    """Seconds of each request, by kind."""
    taken: dict[str, list[float]] = {"reads": [], "submits": []}

    async def ask(number: int) -> None:
        started = time.perf_counter()
        if number % round(1 / options.submits) == 0:
            kind, answer = "submits", await client.post("/v1/jobs", json=mug(QUEUED, number))
        else:
            job = jobs[number % len(jobs)]
            path = (f"/v1/jobs/{job}", "/v1/jobs?limit=50", "/v1/workers", f"/v1/jobs/{job}", "/v1/objects")[number % 5]
            kind, answer = "reads", await client.get(path)
        answer.raise_for_status()
        taken[kind].append(time.perf_counter() - started)

    tasks, beginning = [], time.perf_counter()
    for number in range(round(options.rate * options.seconds)):
        await asyncio.sleep(max(0.0, beginning + number / options.rate - time.perf_counter()))
        tasks.append(asyncio.create_task(ask(number)))
    await asyncio.gather(*tasks)
    return taken


async def run(url: str, options: argparse.Namespace) -> dict[str, list[float]]:
    """All of it against the server at ``url``."""
    async with httpx.AsyncClient(base_url=url, timeout=60, trust_env=False) as client:
        jobs = await fill(client, 200)
        await occupy(client, options.workers)
        return await measure(client, jobs, options)


def row(kind: str, seconds: Sequence[float]) -> list[Any]:
    """Kind, count, median, 99 % and worst in milliseconds, the mark."""
    cuts = statistics.quantiles(seconds, n=100)
    milliseconds = [f"{1000 * value:.1f}" for value in (cuts[49], cuts[98], max(seconds))]
    return [kind, len(seconds), *milliseconds, f"{1000 * MARKS[kind]:.0f}"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--rate", type=float, default=50.0, help="requests per second")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--submits", type=float, default=0.2, help="share of the requests")
    options = parser.parse_args()
    os.environ["TROMPE_RATE_LIMIT"] = "0"
    os.environ.pop("TROMPE_DATA", None)
    with embedded_server(command=(*SERVE[:-1], "--workers", str(options.workers), SERVE[-1])) as url:
        taken = asyncio.run(run(url, options))
    print(f"{options.rate:g} requests/s, {options.workers} attack workers computing; {machine()}\n")
    header = ["", "requests", "p50 (ms)", "p99 (ms)", "worst (ms)", "mark for p99 (ms)"]
    print(markdown_table(header, [row(kind, seconds) for kind, seconds in taken.items()]))


if __name__ == "__main__":
    main()
