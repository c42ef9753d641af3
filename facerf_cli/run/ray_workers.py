"""Items as tasks of Ray, for `--ray`: on this machine's processors or a cluster's (docs/clusters.md).

Ray itself would try a task again without asking; here the driver does, because it looks first whether the
lost worker had finished. All machines must see the same files under the same paths.
"""

import importlib
import logging
import os
import queue
import signal
import socket
import warnings
from collections import deque
from collections.abc import Callable, Generator, Sequence
from contextlib import chdir
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from facerf_cli._version import __version__
from facerf_cli.errors import FacerfError, UsageError
from facerf_cli.run.logs import LOGGER_NAME, log_to_queue, one_line
from facerf_cli.run.machine import processors

T = TypeVar("T")
R = TypeVar("R")
LOCAL = "local"
_NO_MODULES = Path(__file__).parents[1] / "assets"
_ATTEMPTS = 3  # at an item whose workers are lost
_PATIENCE_S = 10
_STORE_BYTES = 256 << 20  # of shared memory; what goes through it is settings
# Before Ray is imported: nothing is sent home or announced, a wrong address is given up in half a minute, and
# the workers of this machine are as nice as `--jobs`' are (Ray's own 15 starves them beside other programs).
_ENVIRONMENT = {
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_ENABLE_METRICS_COLLECTION": "0",
    "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "1",
    "RAY_worker_niceness": "0",
    "RAY_NUM_REDIS_GET_RETRIES": "2",
    "RAY_py_gcs_connect_timeout_s": "5",
}
_PASSED_ON = ("OCIO",)  # variables of this process that say what a picture's colours are
log = logging.getLogger(LOGGER_NAME)


def in_ray(
    work: Callable[[T], R],
    items: Sequence[T],
    address: str,
    jobs: int,
    gpus: int | None,
    broken: Callable[[T, Exception], R],
) -> Generator[tuple[int, R]]:
    """Each item's number and result as they come; `jobs` tasks at a time, 0 for as many as there are CPUs.

    A task has one CPU, one thread, and `gpus` GPUs; None: one where the cluster has any. An item whose worker
    is lost is tried again, twice.
    Raises `UsageError` where there is no Ray, or none at the address.
    """
    ray = connect(address, jobs)
    if gpus is None:
        gpus = int(ray.cluster_resources().get("GPU", 0) >= 1)
    _warn_of_what_lacks(ray, gpus)
    task = ray.remote(num_cpus=1, num_gpus=gpus, max_retries=0)(_task)
    shared, site = ray.put(work), _Site.here()
    waiting = deque((number, 1) for number in range(len(items)))
    running: dict[Any, tuple[int, int]] = {}
    try:
        while waiting or running:
            at_once = jobs or 2 * max(1, int(ray.cluster_resources().get("CPU", 1)))  # a cluster may grow
            while waiting and len(running) < at_once:
                number, attempt = waiting.popleft()
                running[task.remote(shared, items[number], site)] = number, attempt
            for reference in ray.wait(list(running), timeout=1)[0]:
                number, attempt = running.pop(reference)
                answer = _answer_of(ray, reference)
                if isinstance(answer, _Answer):
                    answer.log()
                    yield number, answer.result
                elif attempt < _ATTEMPTS:
                    log.warning("a worker was lost; its item is tried again (%s)", answer)
                    waiting.appendleft((number, attempt + 1))
                else:
                    error = ChildProcessError(f"{attempt} times; the last: {answer}")
                    yield number, broken(items[number], error)
    except ray.exceptions.RayError as error:
        raise FacerfError(
            f"--ray {address}: the cluster was lost ({_first_sentence(error)}); start it again, then run the "
            "same command, which continues"
        ) from error
    finally:
        _cancel(ray, list(running))


def connect(address: str, jobs: int = 0) -> Any:
    """The module `ray`, connected; it stays so until this process ends. Errors as of `in_ray`."""
    token = Path.home() / ".ray" / "auth_token"
    show_token = {"RAY_AUTH_MODE": "token"} if address != LOCAL and token.is_file() else {}
    for name, value in (_ENVIRONMENT | show_token).items():
        os.environ.setdefault(name, value)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Ray's, of its own future
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
    if address == LOCAL:
        options |= {"num_cpus": jobs or processors(), "object_store_memory": _STORE_BYTES}
        options["include_dashboard"] = False
    else:
        _require_listener(address)
    ours = signal.getsignal(signal.SIGTERM)
    try:
        with chdir(_NO_MODULES):  # Ray lets workers import from the folder where it is started
            ray.init(address=address, **options)
    except (OSError, RuntimeError, ValueError, AssertionError, ray.exceptions.RayError) as error:
        if "AF_UNIX" in str(error):
            raise UsageError(
                f"--ray {address}: TMPDIR has too long a name for Ray; set TMPDIR=/tmp"
            ) from error
        raise UsageError(f"--ray {address}: {_first_sentence(error)}") from error
    finally:
        signal.signal(signal.SIGTERM, ours)  # Ray sets one of its own
    # A thread of Ray's tells standard output, which is for results, of workers that died; so do we.
    innards: Any = importlib.import_module("ray._private.worker")
    innards.print_to_stdstream = lambda *_, **__: None


def _require_listener(address: str) -> None:
    """Raise UsageError where nobody answers: Ray alone would take minutes to give up."""
    if address == "auto":
        return
    host, _, port = address.rpartition(":")
    if not host or not port.isdecimal() or "/" in host:
        raise UsageError(f"--ray {address}: give HOST:PORT of the head of a cluster, auto, or local")
    try:
        socket.create_connection((host.strip("[]"), int(port)), timeout=_PATIENCE_S).close()
    except (OSError, OverflowError) as error:
        reason = getattr(error, "strerror", None) or error
        raise UsageError(f"--ray {address}: cannot be reached ({reason}); is Ray's head there?") from None


def _warn_of_what_lacks(ray: Any, gpus: int) -> None:
    """Say what tasks will wait for; a cluster that grows may yet get it."""
    have = ray.cluster_resources()
    for name, wanted in (("CPU", 1), ("GPU", gpus)):
        if have.get(name, 0) < wanted:
            log.warning("the Ray cluster has no %s now; tasks wait for one", name)


def _answer_of(ray: Any, reference: Any) -> "_Answer | str":
    """A task's answer, or how its worker was lost; what it raised is raised here."""
    errors = ray.exceptions
    lost = (errors.WorkerCrashedError, errors.NodeDiedError, errors.OutOfMemoryError, errors.ObjectLostError)
    try:
        return ray.get(reference)
    except errors.RayTaskError as error:
        if isinstance(error.cause, Exception):
            raise error.cause from None
        raise FacerfError(f"--ray: {_first_sentence(error)}") from error
    except lost as error:
        return _first_sentence(error)
    except errors.LocalRayletDiedError:  # the node of this process
        raise
    except errors.RayError as error:
        raise FacerfError(f"--ray: {_first_sentence(error)}") from error


def _first_sentence(error: Exception) -> str:
    """Ray explains its errors at length; this much goes into a line."""
    return one_line(str(error)).split(". ")[0][:200] or type(error).__name__


def _cancel(ray: Any, running: list[Any]) -> None:
    """Interrupt tasks, which lets them take their temporary files away, and end by force those that stay."""
    if not (running and ray.is_initialized()):
        return
    for reference in running:
        ray.cancel(reference)
    for reference in ray.wait(running, num_returns=len(running), timeout=_PATIENCE_S)[1]:
        ray.cancel(reference, force=True)


@dataclass(frozen=True)
class _Site:
    """Facts of the process that sent a task."""

    folder: str
    version: str
    level: int
    environment: tuple[tuple[str, str], ...]

    @staticmethod
    def here() -> "_Site":
        passed = tuple((name, os.environ[name]) for name in _PASSED_ON if name in os.environ)
        return _Site(os.getcwd(), __version__, log.level, passed)

    def enter(self) -> None:
        """Make a worker work as if in the sender's place: relative paths lead where they led there."""
        host = socket.gethostname()
        if self.version != __version__:
            raise UsageError(f"--ray: {host} has facerf {__version__}, and this is {self.version}")
        if not Path(self.folder).is_dir():
            raise UsageError(f"--ray: {host} has no {self.folder}; all machines must share the files")
        os.chdir(self.folder)
        os.environ.update(self.environment)


@dataclass(frozen=True)
class _Answer:
    """An item's result, and what was logged on the way."""

    result: Any
    records: list[logging.LogRecord]

    def log(self) -> None:
        for record in self.records:
            log.handle(record)


def _task(work: Callable[[Any], Any], item: Any, site: _Site) -> _Answer:
    """Run one item in a worker of Ray."""
    site.enter()
    records: queue.SimpleQueue[logging.LogRecord] = queue.SimpleQueue()
    log_to_queue(records, site.level)
    result = work(item)
    return _Answer(result, [records.get() for _ in range(records.qsize())])
