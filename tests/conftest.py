"""Fixtures and checks for all tests."""

import dataclasses
import gc
import os
import pickle
import random
import shutil
import signal
import tempfile
from collections import Counter
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import pytest
from _pytest.doctest import DoctestModule
from hypothesis import settings

from aerpaw_cmp.common.text import counted
from tests.real_logs import REAL

# In CI the same examples run every time, so that a red run can be repeated; elsewhere every run looks further.
# No deadlines: a busy machine is not an error.
settings.register_profile("further", deadline=None)
settings.register_profile("fixed", derandomize=True, deadline=None)
settings.load_profile("fixed" if os.environ.get("CI") else "further")

# One worker per core: the threads of a linear algebra library would only wait for each other. Before numpy is loaded.
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

# While tests are collected, objects are only added: each worker would search them for a second.
gc.disable()

# nohup, and shells for jobs in the background, leave signals ignored, which every child of a test would inherit. What
# ends a run from outside (timeout, a closed terminal) does so as Ctrl-C: pytest then takes its folders away.
for _ending in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
    signal.signal(_ending, signal.default_int_handler)

# Nothing kept on this machine decides a test, and no test leaves anything in the user's cache. Workers of pytest-xdist
# have a folder each, in that of the run; that this machine's LLVM works is found out once for all of them.
_OF_ALL = os.environ.get("AERPAW_CMP_CACHE", "") if "PYTEST_XDIST_WORKER" in os.environ else ""
_NAME = "aerpaw-cmp-tests-"
_OWN = os.environ["AERPAW_CMP_CACHE"] = tempfile.mkdtemp(prefix=f"{_NAME}{os.getpid()}-", dir=_OF_ALL or None)
if _OF_ALL:
    Path(_OF_ALL, "llvm").mkdir(exist_ok=True)
    Path(_OWN, "llvm").symlink_to(Path(_OF_ALL, "llvm"))
else:
    for _left in Path(_OWN).parent.glob(f"{_NAME}*-*"):  # by runs that were killed
        try:
            os.kill(int(_left.name.removeprefix(_NAME).partition("-")[0]), 0)
        except ProcessLookupError:
            shutil.rmtree(_left, ignore_errors=True)
        except (PermissionError, ValueError):  # of another user, or with another name
            continue


# Files that take longest, by and large in that order.
DEAREST = (
    "propagation/test_growth.py",  # compiles for half a minute where nothing is kept yet; the other worker needs it later
    "field/test_learned_site.py",
    "test_field.py",  # the first that needs Sionna: by now one worker knows whether this machine's LLVM works
    "parsers/test_law.py",
    "jobs/test_workers.py",
    "live/test_web_browser.py",
    "live/test_tap.py",
    "jobs/test_training_logs.py",
    "flight/test_clock.py",
    "flight/test_draft.py",
    "jobs/test_map_store.py",  # also runs compiled code: not earlier, or it would compile at the same time as the first
    "propagation/test_compiled.py",
    "jobs/test_plan.py",
    "test_published.py",
    "report/test_figures.py",
    "long/test_long.py",
    "compare/test_locate.py",
    "compare/test_direction_gain.py",
    "test_examples.py",
    "test_round_trip.py",
    "propagation/test_llvm.py",
)


def pytest_configure(config: pytest.Config) -> None:
    """Workers collect beginning at different files: each rewrites asserts of its own, and finds those of the others.

    In one order, all would rewrite every file side by side where no bytecode is kept yet.
    """
    worker = os.environ.get("PYTEST_XDIST_WORKER", "")
    if worker and [Path(arg).name for arg in config.args] == config.getini("testpaths"):
        files = [str(path) for path in sorted(Path(__file__).parent.rglob("test_*.py"))]
        first = len(files) * int(worker[2:]) // int(os.environ["PYTEST_XDIST_WORKER_COUNT"])
        config.args[:] = [*files[first:], *files[:first], *config.args[1:]]


def pytest_addoption(parser: pytest.Parser) -> None:
    """``--shuffle SEED``: no test may need another to have run before it."""
    parser.addoption("--shuffle", type=int, default=None, metavar="SEED", help="files, and tests in them, in any order")


def skips(reasons: Iterable[str]) -> str:
    """Print the number of skipped tests and the reasons as the last line of ``make test``."""
    counts = Counter(reason.removeprefix("Skipped: ") for reason in reasons)
    return (
        "; ".join(f"skipped: {counted(n, 'test')}, {reason}" for reason, n in counts.most_common()) or "skipped: none"
    )


def pytest_terminal_summary(terminalreporter: Any, config: pytest.Config) -> None:
    if (cache := getattr(config, "cache", None)) is not None:
        reasons = (str(report.longrepr[2]) for report in terminalreporter.stats.get("skipped", ()))
        (cache.mkdir("skipped") / "said").write_text(skips(reasons) + "\n")


def pytest_unconfigure() -> None:
    """Remove the folder of the test run at its end: field logs and paths need some ten megabytes."""
    shutil.rmtree(_OWN, ignore_errors=True)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers() -> int | None:
    """Workers for ``-n auto``, which would count cores: one for two threads, and those of the host in a container.

    On few threads one more than there are: tests of the tap, of pages and of commands wait for others a good part of
    their time.
    """
    if os.environ.get("PYTEST_XDIST_AUTO_NUM_WORKERS") or not hasattr(os, "sched_getaffinity"):
        return None
    threads = len(os.sched_getaffinity(0))
    try:
        quota, period = Path("/sys/fs/cgroup/cpu.max").read_text().split()
        granted = max(1, int(quota) // int(period))
    except (OSError, ValueError):  # no control group, or no limit
        granted = threads
    return granted + 1 if granted in (2, 3) else granted if granted < threads else None


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Shuffle files and tests with the seed, equally in every process, or else run the longest files first.

    A worker that begins its last file late would leave the others without work.
    """
    items.sort(key=lambda item: item.path)
    for item in items:
        if item.get_closest_marker("field") and not REAL.is_dir():
            item.add_marker(pytest.mark.skip(reason="AERPAW_CMP_FIELD_DATA is not set: no real logs"))
    seed = config.getoption("--shuffle")
    if seed is None:
        place = {name: number for number, name in enumerate(DEAREST)}
        items.sort(key=lambda item: place.get(item.nodeid.partition("::")[0].removeprefix("tests/"), len(DEAREST)))
        return
    files: dict[Path, list[pytest.Item]] = {}
    for item in items:
        files.setdefault(item.path, []).append(item)
    draw = random.Random(seed)
    order = list(files.values())
    draw.shuffle(order)
    for tests in order:
        draw.shuffle(tests)
    items[:] = [item for tests in order for item in tests]


def pytest_collection_finish() -> None:
    """Freeze imported and collected objects, so that the garbage collector does not search them again."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(20_000, 20, 50)
    gc.enable()


@pytest.hookimpl(wrapper=True)
def pytest_collect_file() -> Generator[None, list[pytest.Collector], list[pytest.Collector]]:
    """No doctests here: their collector would import what tests run in processes of their own, dask's clusters too."""
    collectors = yield
    return [collector for collector in collectors if not isinstance(collector, DoctestModule)]


@pytest.fixture(scope="module")
def sionna() -> Any:
    """Return the module that drives Sionna RT, with its variant loaded.

    Skip the test if Sionna RT or a device for Dr.Jit is missing.
    """
    from aerpaw_cmp.propagation.llvm import let_sionna_load

    let_sionna_load()
    pytest.importorskip("sionna.rt", reason="Sionna RT is not installed")
    from aerpaw_cmp.common.errors import CheckError, UsageError
    from aerpaw_cmp.propagation.search import sionna

    try:
        sionna.load_variant()
    except (CheckError, UsageError) as error:
        pytest.skip(f"no device for Dr.Jit: {error}")
    gc.collect()
    gc.freeze()  # each scene that is freed ends with a collection
    return sionna


@pytest.fixture(scope="module")
def blank_pictures() -> Iterator[None]:
    """Every figure is made from its data as ever, and then an empty one of its size is saved: an eighth of the time.

    For tests that run a command to its end and look at no picture.
    """
    from matplotlib.figure import Figure

    from aerpaw_cmp.report import canvas

    def save_as(fig: Any, formats: Sequence[str]) -> dict[str, bytes]:
        return dict(blank(tuple(fig.get_size_inches()), tuple(formats)))  # the caller may take from it

    @cache
    def blank(size: tuple[float, float], formats: tuple[str, ...]) -> dict[str, bytes]:
        return real(Figure(figsize=size), formats)

    real = canvas.save_as
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(canvas, "save_as", save_as)
        yield


@pytest.fixture(scope="module")
def few_pictures(blank_pictures: None) -> Iterator[None]:
    """Also, a figure is made from its data once per module: for usual flights that many tests of a module report."""
    from matplotlib.figure import Figure

    from aerpaw_cmp.report import canvas

    def render(spec: Any, *how: Any) -> Any:
        if spec.name in made:
            spec = dataclasses.replace(spec, draw=Figure)
        made.add(spec.name)
        return real(spec, *how)

    real, made = canvas.render, set[str]()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(canvas, "render", render)
        yield


@pytest.fixture(autouse=True, scope="module")
def no_wait_for_the_disk(request: pytest.FixtureRequest) -> Iterator[None]:
    """Skip fsync in tests that only read outputs. An invalid descriptor is still an error."""
    with pytest.MonkeyPatch.context() as patch:
        if request.path.parent.name in ("jobs", "maps", "report", "site", "tests"):
            patch.setattr(os, "fsync", lambda descriptor: os.fstat(descriptor) and None)
        yield


@pytest.fixture(scope="session")
def field_logs() -> Any:
    """Every log of AERPAW_CMP_FIELD_DATA, to be looked at only: read by the first worker that asks."""
    from aerpaw_cmp.logs.ingest import ingest
    from aerpaw_cmp.logs.readers import ReadOptions

    store = Path(_OF_ALL or os.environ["AERPAW_CMP_CACHE"]) / "field_logs.pickle"
    if store.exists():
        return pickle.loads(store.read_bytes())
    ingested = ingest(REAL, options=ReadOptions(timezone="America/New_York"))
    part = store.with_suffix(f".{os.getpid()}")
    part.write_bytes(pickle.dumps(ingested))
    part.replace(store)
    return ingested


@pytest.fixture
def cf_faults() -> Callable[[Path], list[str]]:
    """Return the complaints of the CF checker about a NetCDF file."""
    return _cf_faults


def _cf_faults(path: Path) -> list[str]:
    """Return the complaints of compliance-checker about a file, for the CF version that the file states."""
    import netCDF4

    pytest.importorskip("compliance_checker")
    from compliance_checker.runner import CheckSuite

    with netCDF4.Dataset(path) as book:
        version = book.Conventions.removeprefix("CF-")
    suite = CheckSuite()
    suite.load_all_available_checkers()
    book = suite.load_dataset(str(path))
    scores = suite.run_all(book, [f"cf:{version}"], skip_checks=[])
    book.close()
    groups, errors = scores[f"cf:{version}"]
    assert not errors
    return [text for group in groups for text in _messages(group)]


def _messages(result: Any) -> list[str]:
    """Return each result that did not get all its points."""
    if result.children:
        return [text for child in result.children for text in _messages(child)]
    value = result.value
    full = value[0] == value[1] if isinstance(value, tuple) else bool(value)
    return [] if full else list(result.msgs or [f"{result.name}: {value}"])
