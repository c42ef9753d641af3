"""Items as tasks of Ray, for `--ray`: on this machine's processors or a cluster's (docs/clusters.md).

Ray itself repeats a task whose worker is lost. All machines must see the same files under the same paths.
"""

import importlib
import logging
import os
import queue
import signal
import socket
import warnings
from collections.abc import Callable, Generator, Sequence
from contextlib import chdir
from itertools import islice
from pathlib import Path
from typing import Any, TypeVar

from facerf_cli._version import __version__
from facerf_cli.errors import FacerfError, UsageError
from facerf_cli.run.logs import LOGGER_NAME, log_to_queue, one_line
from facerf_cli.run.machine import processors

T = TypeVar("T")
R = TypeVar("R")
_NO_MODULES = Path(__file__).parents[1] / "assets"
_REPEATS = 2  # of an item whose worker is lost
_PATIENCE_S = 10
_STORE_BYTES = 256 << 20  # of shared memory, which only settings go through
# Set before Ray is imported: no telemetry, a wrong address fails within half a minute, a task that exceeds
# the memory is not repeated for ever, and the workers of this machine have the priority that `--jobs` has
# (Ray's own niceness of 15 starves them beside others).
_ENVIRONMENT = {
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_ENABLE_METRICS_COLLECTION": "0",
    "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "1",
    "RAY_worker_niceness": "0",
    "RAY_task_oom_retries": str(_REPEATS),
    "RAY_NUM_REDIS_GET_RETRIES": "2",
    "RAY_py_gcs_connect_timeout_s": "5",
}
_PASSED_ON = ("OCIO",)  # variables of this process that define an image's colours
log = logging.getLogger(LOGGER_NAME)


def in_ray(
    work: Callable[[T], R],
    items: Sequence[T],
    died: Callable[[T, Exception], R],
    address: str,
    jobs: int = 0,
    gpus: int | None = None,
) -> Generator[tuple[int, R]]:
    """Yield the number and result of each item as they come.

    A task has one processor, one thread and `gpus` GPUs; None: one if the cluster has any. At most `jobs`
    tasks run at a time; 0: as many as Ray has processors. Raises UsageError if Ray is not installed, or does
    not run at the address.
    """
    ray = connect(address, jobs)
    gpus = int(ray.cluster_resources().get("GPU", 0) >= 1) if gpus is None else gpus
    if ray.cluster_resources().get("GPU", 0) < gpus:  # a cluster that grows may yet get it
        log.warning("the Ray cluster has no GPU now; tasks wait for one")
    task = ray.remote(num_cpus=1, num_gpus=gpus, max_retries=_REPEATS)(_task)
    environment = {name: os.environ[name] for name in _PASSED_ON if name in os.environ}
    shared = ray.put((work, os.getcwd(), __version__, log.level, environment))
    errors, waiting, running = ray.exceptions, iter(range(len(items))), dict[Any, int]()
    lost = (errors.WorkerCrashedError, errors.NodeDiedError, errors.OutOfMemoryError, errors.ObjectLostError)
    try:
        while True:
            at_once = jobs or 2 * max(1, int(ray.cluster_resources().get("CPU", 1)))  # a cluster may grow
            for number in islice(waiting, max(0, at_once - len(running))):
                running[task.remote(shared, items[number])] = number
            if not running:
                return
            for reference in ray.wait(list(running), timeout=1)[0]:
                number = running.pop(reference)
                try:
                    result, records = ray.get(reference)
                except lost as error:
                    yield number, died(items[number], ChildProcessError(_first_sentence(error)))
                else:
                    for record in records:
                        log.handle(record)
                    yield number, result
    except errors.RayTaskError as error:
        raise error.cause from None
    except errors.RayError as error:
        raise FacerfError(
            f"--ray {address}: the cluster was lost ({_first_sentence(error)}); start it again, then run the "
            "same command, which continues"
        ) from error
    finally:
        if running and ray.is_initialized():  # an interrupted task removes its temporary files
            for reference in running:
                ray.cancel(reference)
            for reference in ray.wait(list(running), num_returns=len(running), timeout=_PATIENCE_S)[1]:
                ray.cancel(reference, force=True)


def connect(address: str, jobs: int = 0) -> Any:
    """Return the module `ray`, connected until this process ends. Raises UsageError as `in_ray` does."""
    token = Path.home() / ".ray" / "auth_token"
    show_token = {"RAY_AUTH_MODE": "token"} if address != "local" and token.is_file() else {}
    for name, value in (_ENVIRONMENT | show_token).items():
        os.environ.setdefault(name, value)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Ray's, about its own future
        try:
            ray = importlib.import_module("ray")
        except ImportError:
            raise UsageError("--ray: Ray is not installed; pip install 'facerf[ray]'") from None
        if not ray.is_initialized():
            _initialise(ray, address, jobs)
    return ray


def _initialise(ray: Any, address: str, jobs: int) -> None:
    logging.getLogger("ray").setLevel(logging.ERROR)
    options: dict[str, Any] = {
        "log_to_driver": False,
        "logging_level": logging.ERROR,
        "runtime_env": {"env_vars": {"PYTHONSAFEPATH": "1"}},
    }
    if address == "local":
        options |= {"num_cpus": jobs or processors(), "object_store_memory": _STORE_BYTES}
        options["include_dashboard"] = False
    elif address != "auto":
        _require_listener(address)
    ours = signal.getsignal(signal.SIGTERM)
    try:
        with chdir(_NO_MODULES):  # Ray lets workers import from the folder where it is started
            ray.init(address=address, **options)
    except (OSError, RuntimeError, ValueError, AssertionError, ray.exceptions.RayError) as error:
        raise UsageError(f"--ray {address}: {_first_sentence(error)}; see docs/clusters.md") from error
    finally:
        signal.signal(signal.SIGTERM, ours)  # Ray sets its own
    # A thread of Ray reports dead workers on standard output, which is for results; facerf logs them.
    internals: Any = importlib.import_module("ray._private.worker")
    internals.print_to_stdstream = lambda *_, **__: None


def _require_listener(address: str) -> None:
    """Raise UsageError if there is no server at an address: Ray itself would take minutes to give up."""
    host, _, port = address.rpartition(":")
    if not host or not port.isdecimal() or "/" in host:
        raise UsageError(f"--ray {address}: not an address; use HOST:PORT of a cluster's head, auto or local")
    try:
        socket.create_connection((host.strip("[]"), int(port)), timeout=_PATIENCE_S).close()
    except (OSError, OverflowError) as error:
        raise UsageError(f"--ray {address}: cannot be reached ({error}); start Ray's head there") from None


def _first_sentence(error: Exception) -> str:
    """Return the first sentence of one of Ray's long explanations."""
    return one_line(str(error)).split(". ")[0][:200] or type(error).__name__


def _task(shared: tuple[Any, ...], item: Any) -> tuple[Any, list[logging.LogRecord]]:
    """Process one item in a worker of Ray, with the sender's working folder and variables.

    Returns the result and the log records.
    """
    work, folder, version, level, environment = shared
    host = socket.gethostname()
    if version != __version__:
        raise UsageError(f"--ray: {host} has facerf {__version__}, and this is {version}")
    if not Path(folder).is_dir():
        raise UsageError(f"--ray: {host} has no {folder}; all machines must share the files")
    os.chdir(folder)  # so that relative paths are the sender's
    os.environ.update(environment)
    records: queue.SimpleQueue[logging.LogRecord] = queue.SimpleQueue()
    log_to_queue(records, level)
    result = work(item)
    return result, [records.get() for _ in range(records.qsize())]
