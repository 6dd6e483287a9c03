"""Verbs about time: bench measures it, warmup saves it."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer

from fringescope.cli.app import app
from fringescope.cli.common import Json, Progress, emit
from fringescope.errors import OutputError, UsageError


@app.command()
def bench(
    megapixels: Annotated[float, typer.Option(help="Size of a camera's picture.")] = 20.0,
    repeat: Annotated[int, typer.Option(help="Times that each thing is timed; the median counts.")] = 5,
    growth: Annotated[
        bool, typer.Option("--growth", help="Also 0.25 to 80 megapixels (8 GB of memory), frames and cores.")
    ] = False,
    plot: Annotated[Path | None, typer.Option(help="Draw the growth into this SVG file.")] = None,
    whole: Annotated[bool, typer.Option("--whole", help="Also three views to a coloured cloud and meshes.")] = False,
    peer_python: Annotated[
        Path | None, typer.Option(help="A Python that has other decoders (fringes), to be timed as well.")
    ] = None,
    json: Json = False,
) -> None:
    """Times a scan against a plain copy of the same memory and against other decoders, all in one run."""
    from fringescope import bench as benchmark

    if plot is not None and (plot.is_dir() or not plot.parent.is_dir()):
        raise OutputError(f"--plot {plot}: needed a file in a folder that exists; make the folder first")
    if peer_python is not None and not os.access(peer_python, os.X_OK):
        raise UsageError(f"--peer-python {peer_python}: needed a Python interpreter that can be run")
    with Progress() as progress:
        result = benchmark.measure(
            megapixels, repeat, growth=growth or plot is not None, whole=whole, peer_python=peer_python,
            tell=progress.share,
        )  # fmt: skip
    emit(result, json, benchmark.lines(result))
    if plot is not None:
        from fringescope.bench.plot import drawing

        try:
            plot.write_text(drawing(result), encoding="utf-8")
        except OSError as e:
            raise OutputError(f"--plot {plot}: cannot be written: {e.strerror}") from e


@app.command()
def warmup(json: Json = False) -> None:
    """Compiles the kernels for this processor now, so that no scan need; they are kept on disk.

    Takes two minutes or more the first time, seconds when all is there. Without it the first scan takes as long.
    """
    from time import perf_counter

    start = perf_counter()
    with Progress() as progress:

        def work() -> int:
            from fringescope.warmup import compile_kernels

            return compile_kernels(every_plan=True)

        points = progress.run("compiling", work)
    seconds = perf_counter() - start
    emit({"points": points, "seconds": seconds}, json, [f"kernels are compiled ({seconds:.1f} s)"])
