"""A Dask cluster for the blocks of a map or for rigs: threads or processes of this machine, or a running cluster."""

import logging
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from typing import TYPE_CHECKING

from capsule_id.errors import InputError

if TYPE_CHECKING:
    from distributed import Client

#: Longest wait for a scheduler at an address, s.
CONNECT_TIMEOUT = 10.0


def client_of(scheduler: str | None) -> "AbstractContextManager[Client | None]":
    """A context manager: a Dask client, or None to compute in this process."""
    return nullcontext() if scheduler is None else cluster(scheduler)


@contextmanager
def cluster(scheduler: str) -> "Iterator[Client]":
    """A client of a local cluster ("threads", "processes") or of the scheduler at an address. A local cluster ends with it.

    Raises
    ------
    InputError
        If Dask is not installed, or no scheduler answers at the address.
    """
    try:
        import distributed  # noqa: F401
        from dask import config
    except ImportError:
        remedy = "install capsule-id[maps], or remove --scheduler"
        raise InputError("--scheduler needs Dask", "distributed is not installed", remedy) from None
    # A client that no scheduler answers does not restore the setting of Dask, and nothing could be computed later.
    with config.set(scheduler=config.get("scheduler", None)), _client(scheduler) as client:
        yield client


@contextmanager
def _client(scheduler: str) -> "Iterator[Client]":
    from distributed import Client, LocalCluster

    if scheduler not in ("threads", "processes"):
        try:
            client = Client(scheduler, timeout=CONNECT_TIMEOUT)
        except (OSError, ValueError) as error:
            rule = "--scheduler is threads, processes or the address of a Dask scheduler"
            raise InputError(
                rule, f"{scheduler}: {type(error).__name__}", "start the scheduler, or check the address"
            ) from None
        with client:
            yield client
        return
    # Each process computes with as many threads as there are cores; see physics/batches.py.
    processes = scheduler == "processes"
    local = {
        "processes": processes,
        "threads_per_worker": 1 if processes else None,
        "dashboard_address": None,
        "silence_logs": logging.CRITICAL,
    }
    with LocalCluster(**local) as workers, Client(workers) as client:
        yield client
