"""Settings of every test: double precision, strict dtype and rank promotion, a compilation cache kept between runs."""

import contextlib
import ctypes
import gc
import os
import sys
from pathlib import Path

import jax
import pytest

import rodjax
from rodjax.programs.answers import ANSWERS

# Before JAX's first program. Most of the tests' time is compiling: without optimisation half as long, and what is
# compiled runs half as fast. `RODJAX_TESTS_OPTIMIZED` asks for programs as users have them.
IS_OPTIMIZED = bool(os.environ.get("RODJAX_TESTS_OPTIMIZED"))
if not IS_OPTIMIZED:
    os.environ["XLA_FLAGS"] = os.environ.get("XLA_FLAGS", "") + " --xla_backend_optimization_level=0"
    # What these two look for in loops takes another seventh of the time.
    os.environ["XLA_FLAGS"] += " --xla_disable_hlo_passes=while-loop-invariant-code-motion,simplify-while-loops"
    # Parting a program for several threads takes another sixth, and each worker has one core.
    os.environ["XLA_FLAGS"] += " --xla_cpu_parallel_codegen_split_count=1"
    # As `rodjax.programs.compilation.QUICK`, also for the programs in which tests use solves.
    if jax.__version_info__ < (0, 11):
        os.environ["XLA_FLAGS"] += " --xla_cpu_use_fusion_emitters=false"
# Read as NumPy is imported, by workers and processes that tests start: each has one core, on which threads
# for small matrices wait for one another.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# Memory that compiling frees stays with the process: asking the system for it again and again takes 15 % of the time.
if sys.platform == "linux":
    M_TRIM_THRESHOLD, M_TOP_PAD, M_MMAP_THRESHOLD = -1, -2, -3
    with contextlib.suppress(AttributeError):  # not glibc
        mallopt = ctypes.CDLL(None).mallopt
        mallopt(M_TRIM_THRESHOLD, 2**31 - 1)
        mallopt(M_TOP_PAD, 64 * 2**20)
        mallopt(M_MMAP_THRESHOLD, 2**30)
# A test process holds millions of objects that stay, which each full collection would look through again.
gc.set_threshold(100_000, 50, 100)
jax.config.update("jax_enable_x64", True)
jax.devices()  # XLA reads its flags now, before a test that is the first one sets others
jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")
cache = rodjax.enable_compilation_cache()
# Processes that tests start share their programs. Tests themselves replace functions of the library, of which programs
# kept on disk would know nothing.
os.environ["RODJAX_CACHE"] = str(cache / "tests")
# Each worker has one core; tests of threads ask for them.
os.environ["RODJAX_THREADS"] = "1"
rodjax.keep_programs(False)
# Few programs are called so often here that compiling them would pay. What is compared bit by bit is compiled.
ANSWERS.is_patient = True
rodjax.numpy_first(not IS_OPTIMIZED)


def pytest_addoption(parser):
    parser.addoption("--slow", action="store_true", help="run the slow tests too")


# Files whose tests share nothing: each of their tests goes to the worker that is free first. Those of all other files
# stay together, as their fixtures and programs are in the memory of one worker.
APART = ("test_experiments", "test_validation", "test_readme", "test_docs")
# What takes minutes begins first, so that the workers end together; by CPU seconds, those of slow tests included.
LONGEST = (
    "test_branches_in_clips",
    "test_harness_contact",
    "test_contact",
    "test_branches_in_contact",
    "test_bad_input",
    "test_harness_loads",
    "test_batch",
    "test_continuum_clips",
    "test_continuum",
    "test_route",
    "test_harness",
    "test_clips",
    "test_framed",
    "test_hermite",
    "test_cosseratbench",
    "test_clips_frames",
    "test_fit",
    "test_error_estimates",
    "test_tolerances",
    "test_files",
    "test_implicit",
    "test_continuum_frames",
    "test_contact_chain",
    "test_drawn_in",
    "test_friction",
    "test_continuation",
    "test_self_contact",
    "test_rod_contact",
    "test_clocking",
    "test_composition",
    "test_sweep",
    "test_cluster",
    "test_frames_of_literature",
    "test_route_optima",
    "test_docs",
    "test_experiments",
)


def _scope(nodeid: str) -> str:
    """What goes to a worker as a whole."""
    path = nodeid.split("::", 1)[0]
    return nodeid if Path(path).stem in APART else path


def _rank(nodeid: str) -> int:
    """In the order of `LONGEST`; a test by its own name before its file's."""
    file = Path(nodeid.split("::", 1)[0])
    names = f"{file.name}::{nodeid.rsplit('::', 1)[-1]}", file.stem
    return next((LONGEST.index(name) for name in names if name in LONGEST), len(LONGEST))


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config, log):
    from xdist.scheduler import LoadScopeScheduling

    class LongestFirst(LoadScopeScheduling):
        def _split_scope(self, nodeid):
            return _scope(nodeid)

        def _reschedule(self, node):
            # A worker asks for more while it has one test left, not two: with less in hand the workers end together.
            if node.shutting_down or not self.workqueue or self._pending_of(self.assigned_work[node]) < 2:
                super()._reschedule(node)

    config.option.loadscopereorder = False  # not by the number of tests, but as they are collected
    return LongestFirst(config, log)


def pytest_collection_modifyitems(config, items):
    for item in items:
        marks = {mark.name for mark in item.iter_markers()}  # not `keywords`, which has the names of folders too
        if "optimized" in marks and not IS_OPTIMIZED:
            item.add_marker(
                pytest.mark.skip(reason="two programs are the same to the last bit only as users have them")
            )
        if marks & {"slow", "exhaustive"} and not config.getoption("--slow"):
            item.add_marker(pytest.mark.skip(reason="slow: run with --slow"))
    if hasattr(config, "workerinput"):  # of xdist
        items.sort(key=lambda item: _rank(item.nodeid))


@pytest.fixture(autouse=True)
def earlier_tests_are_not_collected():
    """Full collections, for which Hypothesis, imageio and windows ask, went through millions of objects of other tests,
    for up to half a minute each.
    """
    gc.freeze()


@pytest.fixture
def compiled_at_once():
    """No first answers from NumPy code."""
    with rodjax.numpy_first(False):
        yield


@pytest.fixture
def by_numpy_code(monkeypatch):
    """NumPy code for sweeps and windows too, which compile at once: where their numbers are what is tested."""
    for module in ("programs.tasks", "window.session"):
        monkeypatch.setattr(f"rodjax.{module}.compiled_only", lambda is_so=True: contextlib.nullcontext())


@pytest.fixture(scope="session")
def for_processes():
    """`with for_processes():` the library's programs are made as processes make them that tests start, and kept where
    these look for them.
    """

    @contextlib.contextmanager
    def kept():
        rodjax.keep_programs(os.environ["RODJAX_CACHE"])
        try:
            with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
                yield
        finally:
            rodjax.keep_programs(False)

    return kept


@pytest.fixture(scope="session")
def cable() -> rodjax.Rod:
    """Cable C: 1 m long, 10 mm thick, EI = 4.9087e-3 N m^2, GJ/EI = 2/3, EA L^2/EI = 1.6e5."""
    return rodjax.problems.cable()
