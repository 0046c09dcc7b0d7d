"""A Dask cluster for large maps: one of this machine's threads or processes, or one that is already running."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from capsule_id.errors import InputError

if TYPE_CHECKING:
    from distributed import Client

# Seconds in which a scheduler at an address must answer.
ANSWER_WITHIN = 10.0


@contextmanager
def cluster(scheduler: str) -> "Iterator[Client]":
    """A client of the cluster "threads", "processes" or of the scheduler at an address; a local one ends with it.

    Raises
    ------
    InputError
        Dask is not installed, or nobody answers at the address.
    """
    try:
        from distributed import Client, LocalCluster
    except ImportError:
        remedy = "install capsule-id[maps], or leave it out"
        raise InputError("--scheduler needs Dask", "distributed is not installed", remedy) from None
    if scheduler not in ("threads", "processes"):
        try:
            client = Client(scheduler, timeout=ANSWER_WITHIN)
        except (OSError, ValueError) as error:
            rule = "--scheduler is threads, processes or the address of a Dask scheduler"
            raise InputError(rule, f"{scheduler}: {type(error).__name__}", "start it, or check the address") from None
        with client:
            yield client
        return
    # A worker per process computes with as many threads as there are cores: see batches.py.
    processes = scheduler == "processes"
    local = {"processes": processes, "threads_per_worker": 1 if processes else None, "dashboard_address": None}
    with LocalCluster(**local) as workers, Client(workers) as client:
        yield client
