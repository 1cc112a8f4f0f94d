"""Baking on a Dask cluster: shards as tasks that any worker may take up, and a merge when all are done.

A task gets the plan and returns a few numbers; texels never travel. Its worker loads the texture itself, once, and bakes one
shard at a time with as many threads as Dask gave it: tasks that Dask starts beside it wait. Shards are idempotent: a worker
that was killed leaves its share of the staging, whose lock is free at once, and whoever is given the shard next takes up what
is there.
"""

from __future__ import annotations

import argparse
import os
import signal
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache
from typing import TYPE_CHECKING, Any

from solidgrain.bake.messages import first_line
from solidgrain.runtime.errors import BakeError, SolidgrainError

if TYPE_CHECKING:
    from distributed import Client

    from solidgrain.bake.baker import Baked, OnSlice
    from solidgrain.bake.plan import Plan
    from solidgrain.runtime import Texture

RETRIES = 3
PAUSE = 2.0  # seconds before Dask tries a failed shard again: another process that holds it may be done by then
PATIENCE = 10.0  # seconds for a scheduler to answer
LOCAL = "local:"
ALONE = threading.Lock()  # of a worker process: whoever holds it has all of its threads


def parse_cluster(text: str) -> str:
    """ "local:4", or the address of a scheduler."""
    number = text.rpartition(":")[2]  # of processes, or of a port
    if ":" not in text or not number.isdecimal() or int(number) == 0:
        raise argparse.ArgumentTypeError(f"expected local:N or a scheduler such as tcp://host:8786, found {text!r}")
    return text


def bake_on_cluster(
    plan: Plan,
    texture: Texture,
    cluster: str,
    shards: int | None = None,
    on_slice: OnSlice = lambda done, total: None,
    *,
    overwrite: bool = False,
    provider: str = "auto",
    threads: int = 0,
) -> tuple[Baked, list[dict[str, Any]]]:
    """Bake a plan's shards on a cluster ("local:4" or an address), then merge them here.

    Returns the result and what each shard's task said. `threads` are a local cluster's in all, or each remote worker's;
    0: what this process may use, or what the worker was given. What an earlier bake of the plan has left is taken up, and
    what this one leaves when it fails or is interrupted stays; with `overwrite`, what is left of other plans is removed.
    Raises BakeError.
    """
    from solidgrain.bake.baker import Baked, merge
    from solidgrain.bake.farm import anywhere, shard_count
    from solidgrain.bake.staging import clear_leftovers

    started = time.monotonic()
    for output in plan.outputs:  # here, before Dask tries a shard again and again
        clear_leftovers(output.path, plan.work(output), overwrite)
    with _connected(cluster) as client:
        each = max(1, (threads or texture.threads) // _workers(cluster)) if cluster.startswith(LOCAL) else threads
        count = shard_count(plan, shards)
        told = _run_shards(client, anywhere(plan), count, provider, each, on_slice)
    merged = merge(plan, texture.workers)
    evaluation = sum(float(one["evaluation_seconds"]) for one in told)
    return Baked(merged.files, time.monotonic() - started, evaluation, sum(one["reused_slices"] for one in told)), told


def _run_shards(client: Client, plan: Plan, count: int, provider: str, threads: int, on_slice: OnSlice) -> list[dict[str, Any]]:
    """All shards, in any order. The first that fails for good is raised as one of our errors."""
    from distributed import as_completed

    values, done = plan.to_json(), 0
    on_slice(0, plan.size[2])
    futures = {
        client.submit(bake_shard, values, number, count, provider, threads, key=f"shard-{number}-{os.urandom(8).hex()}",
                      retries=RETRIES, pure=False): number
        for number in range(1, count + 1)
    }  # fmt: skip
    told: list[dict[str, Any]] = []
    try:
        for future in as_completed(futures, loop=client.loop):
            with _one_line(f"shard {futures[future]}/{count}"):
                told.append(future.result())
            done += told[-1]["slices"]
            on_slice(done, plan.size[2])
    finally:
        client.cancel(list(futures), force=True)
    return sorted(told, key=lambda one: int(one["shard"]))


def bake_shard(values: dict[str, Any], number: int, count: int, provider: str, threads: int) -> dict[str, Any]:
    """The task: shard `number` of `count` of a plan. Runs in a worker, as often as it must."""
    from distributed import get_worker

    from solidgrain.bake.baker import bake
    from solidgrain.bake.schema import plan_of
    from solidgrain.bake.verify import check_texture

    plan = plan_of(values, "the plan of the Dask task")
    with ALONE:  # or several tasks would load it at once
        each = threads or get_worker().state.nthreads
        hashes = (plan.texture_sha256, plan.sampler_sha256)
        texture = _texture(plan.source, plan.bundle, plan.precision, provider, each, hashes)
    check_texture(plan, texture, f"worker {socket.gethostname()}")
    shard = plan.shard(number, count)
    try:
        with ALONE:
            baked = bake(plan, texture, shard=shard)
    except BakeError:
        time.sleep(PAUSE)
        raise
    return {
        "shard": number,
        "slices": shard[1] - shard[0],
        "reused_slices": baked.reused_slices,
        "seconds": round(baked.seconds, 3),
        "evaluation_seconds": round(baked.evaluation_seconds, 3),
        "provider": texture.provider,
        "host": socket.gethostname(),
        "process": os.getpid(),
    }


@lru_cache(maxsize=1)  # of a worker: a texture holds the tables of its last instance
def _texture(source: str, bundle: str | None, precision: str, provider: str, threads: int, hashes: tuple[str, str]) -> Texture:
    """Loaded once by a worker for the plans that it bakes next; anew, where a file of the same name holds another one now."""
    from solidgrain.runtime import load_texture

    return load_texture(source, bundle=bundle, precision=precision, provider=provider, threads=threads)


def _workers(cluster: str) -> int:
    return int(cluster.removeprefix(LOCAL))


@contextmanager
def _connected(cluster: str) -> Iterator[Client]:
    """A client of a cluster that answers. A local one lives as long as this lasts."""
    import logging

    from distributed import Client, LocalCluster

    if not cluster.startswith(LOCAL):
        _check_scheduler(cluster)
        with _one_line(f"--dask {cluster}"), Client(cluster, timeout=PATIENCE, set_as_default=False) as client:
            yield client
        return
    count = _workers(cluster)
    with (
        LocalCluster(
            n_workers=count,
            threads_per_worker=1,
            processes=True,
            dashboard_address="127.0.0.1:0",
            memory_limit=0,
            silence_logs=logging.CRITICAL,
        ) as local,
        Client(local, set_as_default=False) as client,
    ):
        client.run(_ignore_interrupts)
        yield client


def _ignore_interrupts() -> None:
    """Ctrl-C in a terminal reaches the workers, too: they end when the command ends them."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _check_scheduler(address: str) -> None:
    """Ask who is there: a client by itself waits forever for a listener that is no scheduler."""
    import asyncio

    from distributed.core import rpc

    async def ask() -> None:
        async with rpc(address, timeout=PATIENCE) as scheduler:
            if (await scheduler.identity())["type"] != "Scheduler":
                raise ValueError("it is not a scheduler")

    try:
        asyncio.run(asyncio.wait_for(ask(), PATIENCE))
    except Exception as error:  # the transports raise many unrelated types
        reason = first_line(error, f"no answer in {PATIENCE:.0f} s")
        raise BakeError(f"--dask {address}: no Dask scheduler there ({reason}); start one with `dask scheduler`") from error


@contextmanager
def _one_line(what: str) -> Iterator[None]:
    """Whatever Dask or a worker raises as one of our errors."""
    try:
        yield
    except SolidgrainError:
        raise
    except Exception as error:
        reason = first_line(error, "no reason given")
        raise BakeError(f"{what}: {type(error).__name__}: {reason}") from error
