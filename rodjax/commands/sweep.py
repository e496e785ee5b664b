"""`rodjax sweep` and `rodjax merge`."""

import argparse
import contextlib
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from rodjax.cluster import connected
from rodjax.commands.errors import CommandError
from rodjax.commands.outputs import check_output
from rodjax.io.tables import SUFFIX as TABLE_SUFFIX
from rodjax.sweeps.result import PARQUET_SUFFIX, Summary, check_parquet, merge, write_csv, write_parquet
from rodjax.sweeps.sweep import SUFFIX as SWEEP_SUFFIX
from rodjax.sweeps.sweep import sweep

if TYPE_CHECKING:
    from concurrent.futures import Executor


def run_sweep(arguments: argparse.Namespace) -> int:
    check_output(arguments.output, "-o", (SWEEP_SUFFIX,))
    check_output(arguments.csv, "--csv", (TABLE_SUFFIX,))
    check_output(arguments.parquet, "--parquet", (PARQUET_SUFFIX,))
    if arguments.parquet:
        try:
            check_parquet()
        except ImportError as error:
            raise CommandError(str(error)) from None
    with connection(arguments.scheduler) as executor:
        summary = sweep(
            arguments.scene,
            arguments.over,
            arguments.output,
            shard=arguments.shard,
            chunk=arguments.chunk,
            resume=arguments.resume,
            also=[name.strip() for name in arguments.also.split(",") if name.strip()],
            executor=executor,
            say=lambda line: print(line, flush=True),
        )
    if arguments.csv:
        write_csv(arguments.output, arguments.csv)
    if arguments.parquet:
        write_parquet(arguments.output, arguments.parquet)
    return _swept(arguments.output, summary)


def connection(scheduler: str | None) -> "contextlib.AbstractContextManager[Executor | None]":
    return connected(scheduler, lambda line: print(f"rodjax: {line}", file=sys.stderr, flush=True))


def run_merge(arguments: argparse.Namespace) -> int:
    check_output(arguments.output, "-o", (SWEEP_SUFFIX,))
    return _swept(arguments.output, merge(arguments.shards, arguments.output))


def _swept(path: Path, summary: Summary) -> int:
    """Says what a sweep gave."""
    converged = f"{summary.cases - len(summary.failed)} of {summary.cases} cases converged"
    converged += f", {len(summary.missed)} of them not to rtol = {summary.rtol:g}" if summary.missed else ""
    print(f"{path}: {converged}, error of the shape up to about {summary.error:.0e} of the length")

    def tell(cases: list[int], what: str) -> None:
        first = ", ".join(map(str, cases[:10])) + (", ..." if len(cases) > 10 else "")
        print(f"rodjax: {path}: {len(cases)} of {summary.cases} cases {what}: {first}", file=sys.stderr)

    if summary.failed:
        tell(summary.failed, "not converged")
    if summary.missed:
        tell(summary.missed, f"above rtol = {summary.rtol:g} on the finest mesh")
    if summary.overstretched:
        tell(summary.overstretched, "strained by more than strain_limit")
    return 3 if summary.failed or summary.missed else 0
