"""board: a calibration board to print at true scale."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from fringescope.cli.app import app
from fringescope.cli.common import Force, Json, emit, size
from fringescope.errors import UsageError


@app.command()
def board(
    out: Annotated[Path, typer.Option("--out", help="The page: board.pdf or board.svg.", show_default=False)],
    paper: Annotated[str, typer.Option(help="A5, A4, A3, A2, letter, legal, tabloid or WIDTHxHEIGHT in mm.")] = "A4",
    landscape: Annotated[
        bool | None, typer.Option("--landscape/--portrait", help="Else whichever gives the larger squares.")
    ] = None,
    squares: Annotated[str | None, typer.Option(metavar="CxR", help="Columns x rows, as in 12x9.")] = None,
    square_mm: Annotated[float | None, typer.Option(help="Width of a square; else the largest that fits.")] = None,
    pattern: Annotated[str, typer.Option(help="checkerboard or charuco.")] = "checkerboard",
    marker_mm: Annotated[float | None, typer.Option(help="Width of a marker; else 3/4 of a square.")] = None,
    dictionary: Annotated[str | None, typer.Option(help="OpenCV's name of the markers, as DICT_5X5_100.")] = None,
    invert: Annotated[bool, typer.Option("--invert", help="Swap dark and light squares.")] = False,
    ink: Annotated[float, typer.Option(help="Darkness of the squares: grey (0.1 to 1) still shows fringes.")] = 1.0,
    force: Force = False,
    json: Json = False,
) -> None:
    """A calibration board to print at true scale, with measuring bars and its board.json beside it."""
    from fringescope import export, store

    if out.suffix.lower() not in (".pdf", ".svg"):
        raise UsageError(f"--out {out}; needed a file that ends in .pdf or .svg")
    wanted = size(squares, "--squares") if squares is not None else None
    made = export.best_board(paper, landscape, wanted, square_mm, pattern, marker_mm, dictionary)
    page = export.draw(*made, invert=invert, ink=ink)
    data = export.pdf_bytes(page) if out.suffix.lower() == ".pdf" else export.svg_text(page).encode()
    doc = store.board_document(page.board)
    with (
        store.new_file(out, force=force) as picture,
        store.new_file(out.with_name("board.json"), force=force) as description,
    ):
        picture.write_bytes(data)
        store.write_json(description, doc)
    w, h = page.bar_mm
    lines = [
        f"{out}: {export.describe(page.board, ink)}, on {page.width:g} x {page.height:g} mm",
        f"print at 100 % (no scaling) and measure: {w:g} mm across, {h:g} mm down",
    ]
    if not page.board.ends_differ:
        c, r = page.board.squares
        lines.append(f"{c} x {r} squares look the same after half a turn; {c} x {r - 1} would not")
    told = {"board": doc, "file": str(out), "paper_mm": [page.width, page.height], "bar_mm": [w, h]}
    emit(told, json, lines)
