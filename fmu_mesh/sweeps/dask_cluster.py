"""Variants on the workers of Dask: a cluster that is there, or one of this host.

Dask is optional. It also starts workers that were lost again, and runs their variants anew.
"""

from __future__ import annotations

import logging
import tempfile
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future
from contextlib import ExitStack, contextmanager
from functools import partial
from typing import Any, Final, TypeVar

from ..errors import MeshLost
from ..installing import importing
from ..wire.runtime import remove_stale_folders

__all__ = ["dask_executor"]

_CONNECT_S: Final = 10.0
_PRELOADED: Final = "fmu_mesh.sweeps.preloaded"
_NO_PAGES: Final[dict[str, Any]] = {"distributed.scheduler.http.routes": [], "distributed.worker.http.routes": []}

T = TypeVar("T")


@contextmanager
def dask_executor(address: str | None, workers: int | None = None) -> Iterator[Executor]:
    """The executor of a Dask cluster, until the end of the block: that at ``address``, or one of this host.

    It has that many ``workers``; by default one for each processor.

    Raises:
        LibraryMissing: Dask is not installed.
        MeshLost: the scheduler does not answer.
    """
    with importing("distributed"):
        from dask import config as dask_config  # noqa: PLC0415  an extra, and slow to import
        from distributed import Client, LocalCluster  # noqa: PLC0415  as above
        from distributed.security import Security  # noqa: PLC0415  as above
    logging.getLogger("distributed").setLevel(logging.WARNING)  # it tells every connection
    with ExitStack() as stack:
        where: Any = address
        if address is None:
            stack.callback(remove_stale_folders)  # of workers that were killed
            scratch = stack.enter_context(tempfile.TemporaryDirectory(prefix="fmu_mesh-"))
            stack.enter_context(dask_config.set(_NO_PAGES | {"temporary-directory": scratch}))
            where = LocalCluster(
                n_workers=workers,
                threads_per_worker=1,
                protocol="tls",
                security=Security.temporary(),  # otherwise other users of this host could run code in our name
                dashboard_address="127.0.0.1:0",
                preload=[_PRELOADED],
                scheduler_kwargs={"dashboard": False},
            )
            stack.callback(where.close)
        try:
            client = Client(where, timeout=_CONNECT_S, set_as_default=False)
        except (OSError, ValueError) as error:
            hint = "Is `dask scheduler` running there?"
            raise MeshLost(f"the Dask scheduler at '{address}' does not answer: {error}.", hint=hint) from error
        stack.enter_context(client)
        yield _DaskExecutor(client)


class _DaskExecutor(Executor):
    """The workers of a cluster.

    That of Dask itself (`Client.get_executor`) takes a result for an error if its worker is lost at that moment.
    """

    def __init__(self, client: Any) -> None:  # noqa: ANN401  Dask has no types
        self._client = client
        self._under_way: dict[Future[Any], Any] = {}  # Dask forgets a job whose future is gone

    def submit(self, fn: Callable[..., T], /, *args: Any, **kwargs: Any) -> Future[T]:  # noqa: ANN401  those of any function
        future: Future[T] = Future()
        self._under_way[future] = job = self._client.submit(fn, *args, pure=False, **kwargs)
        job.add_done_callback(partial(self._settle, future))
        return future

    def _settle(self, future: Future[Any], job: Any) -> None:  # noqa: ANN401  Dask has no types
        """On a thread of Dask: a job has ended."""
        del self._under_way[future]
        if not future.set_running_or_notify_cancel():
            return
        try:
            future.set_result(job.result())
        except Exception as error:  # noqa: BLE001  whoever waits gets it
            future.set_exception(error)
