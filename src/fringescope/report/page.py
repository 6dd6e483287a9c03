"""Parts that pages share: words made safe, pictures as thumbnails that open, and the page of a failed calibration."""

from __future__ import annotations

import base64
import html
from collections.abc import Mapping, Sequence

import cv2
import numpy as np

from fringescope.report import svg
from fringescope.types import U8, Calibration, Sighting

MOST_BYTES = 3_500_000  #: all pictures together, as text
WIDTHS = (1000, 760, 560, 420, 320)  #: of pictures, tried until they fit
KEY = "".join(
    f'<span><i style="background:{colour}"></i>{name}</span>'
    for colour, name in (
        ("#ffc400", "corners, row by row"),
        ("#50dc78", "white squares"),
        ("#46beff", "phase samples"),
        ("#ff3c3c", "left out"),
    )
)


def escaped(words: object) -> str:
    """Words as HTML shows them."""
    return html.escape(str(words), quote=True)


def micro(words: str) -> str:
    """The same, with micrometres as people write them."""
    return escaped(words).replace(" um", "\u00a0µm")


def capital(words: str) -> str:
    """A sentence with a capital, unless it begins with a name."""
    return words if words.startswith(("camera", "pose")) else words[:1].upper() + words[1:]


def figure(kind: str, caption: str, drawing: str) -> str:
    """A drawing with its caption; `kind` says how wide it is."""
    return f'<figure class="{kind}"><figcaption>{caption}</figcaption>{drawing}</figure>'


# ------------------------------------------------------------------------------------------------------------- pictures


def pictures(
    c: Calibration | None, sightings: Sequence[Sighting], overlays: Mapping[str, U8], blind: Mapping[str, str]
) -> str:
    """What was found in every picture, or why nothing, with the picture where `overlays` has it by its name."""
    if not sightings and not overlays and not blind:
        return ""
    known = {s.name: s for s in sightings}
    names = sorted(set(known) | set(overlays) | set(blind))
    data = _encoded(overlays)
    left: dict[str, list[str]] = {}
    for o in c.left_out if c is not None else ():
        why = f"{'the sighting' if o.points is None else f'{o.points} point' + 's' * (o.points != 1)} left out: {o.why}"
        for n in names:
            if n.split("/")[0] == o.pose and (o.camera is None or n == f"{o.pose}/{o.camera}"):
                left.setdefault(n, []).append(why)
    cards = []
    for i, name in enumerate(names):
        s = known.get(name)
        what = "no board found"
        if s is not None:
            what = f"{len(s.corner)} corners, {len(s.square)} white squares, {len(s.sample_px)} samples"
        said = (*(s.words if s is not None else (blind.get(name, ""),)), *left.get(name, ()))
        warn = "".join(f'<br><span class="warn">{micro(w)}</span>' for w in said if w)
        img = ""
        if name in data:
            img = f'<img loading="lazy" src="{data[name]}" alt="{escaped(name)}">'
            img = f'<a class="open" href="#picture{i}">{img}</a>'
        cards.append(
            f'<figure id="picture{i}">{img}<figcaption><b>{escaped(name)}</b><br>{what}{warn}</figcaption>'
            '<a class="shut" href="#pictures" aria-label="close"></a></figure>'
        )
    return (
        f'<h2 id="pictures">Pictures</h2><p class="key">What was found.{KEY}</p>'
        f'<div class="pictures">{"".join(cards)}</div>'
    )


def _encoded(overlays: Mapping[str, U8]) -> dict[str, str]:
    """JPEG data URIs of all pictures, as wide as the page's size allows."""
    out: dict[str, str] = {}
    for width in WIDTHS:
        out = {name: _jpeg(picture, width) for name, picture in overlays.items()}
        if sum(map(len, out.values())) <= MOST_BYTES:
            break
    return out


def _jpeg(picture: U8, width: int) -> str:
    h, w = picture.shape[:2]
    if w > width:
        size = (width, max(1, round(h * width / w)))
        picture = np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    bgr = picture[..., ::-1] if picture.ndim == 3 else picture
    _, data = cv2.imencode(".jpg", np.ascontiguousarray(bgr), [cv2.IMWRITE_JPEG_QUALITY, 82])
    return "data:image/jpeg;base64," + base64.b64encode(data.tobytes()).decode("ascii")


# -------------------------------------------------------------------------------------------------------------- failure


def failed(
    failure: str, sightings: Sequence[Sighting], overlays: Mapping[str, U8], blind: Mapping[str, str]
) -> list[str]:
    """What there is to say where no calibration came of it."""
    names = {s.name for s in sightings} | set(overlays) | set(blind)
    poses = sorted({n.split("/")[0] for n in names})
    cameras = sorted({n.split("/")[1] for n in names if "/" in n})
    there = {(s.pose, s.camera): s for s in sightings}
    advice = _advice(sightings, poses, cameras)
    items = "".join(f"<li>{escaped(capital(a))}</li>" for a in advice)
    out = [
        '<section class="card verdict bad"><div class="word">No calibration</div>'
        f'<p class="say">{micro(capital(failure))}</p></section>',
        f'<section class="card next three" style="display:block"><h3>What to do</h3><ul>{items}</ul></section>',
    ]
    if not poses:
        return out
    head = "".join(f"<th>{escaped(k)}</th>" for k in cameras)
    rows = []
    for pose in poses:
        mine = [there.get((pose, k)) for k in cameras]
        found = "".join(f"<td>{len(s.corner)} · {len(s.square)}</td>" if s else "<td class=far>none</td>" for s in mine)
        said = {k: s.words if s else (blind.get(f"{pose}/{k}", ""),) for k, s in zip(cameras, mine, strict=True)}
        of_pose = [blind[pose]] if pose in blind else []
        words = "; ".join([*of_pose, *(f"{k}: {w}" for k, each in said.items() for w in each if w)])
        rows.append(f"<tr><td>{escaped(pose)}</td>{found}<td class=note>{micro(words)}</td></tr>")
    out.append(
        '<h2>What was found</h2><p class="lead">Corners · white squares in each picture.</p>'
        f'<section class="card"><div class="scroll"><table><tr><th>pose</th>{head}'
        f"<th class=note>said about them</th></tr>{''.join(rows)}</table></div></section>"
    )
    plots = []
    for k in cameras:
        seen = [s for s in sightings if s.camera == k]
        if seen:
            w, h = seen[0].size
            at = np.concatenate([s.corner_px for s in seen])
            edges = (np.linspace(-0.5, h - 0.5, 7), np.linspace(-0.5, w - 0.5, 9))
            count = np.histogram2d(at[:, 1], at[:, 0], edges)[0].astype(int)
            caption = f"<b>{escaped(k)}</b>: corners in {100 * float((count > 0).mean()):.0f} % of the picture"
            plots.append(figure("mid", caption, svg.cells(count.tolist(), (w, h))))
    if plots:
        out.append(f'<section class="card"><h3>Coverage</h3><div class="plots">{"".join(plots)}</div></section>')
    return out


def _advice(sightings: Sequence[Sighting], poses: Sequence[str], cameras: Sequence[str]) -> list[str]:
    """Plain next steps, from what was found in which picture."""
    out = []
    if not sightings:
        out.append(
            "no board was found in any picture: check that board.json describes the board (inner corners are one fewer "
            "than squares each way), and that it is lit, in focus and larger than a third of the picture"
        )
    blind = [k for k in cameras if not any(s.camera == k for s in sightings)]
    if blind and sightings:
        out.append(f"{', '.join(blind)} found no board in any pose: is it the right camera, in focus, on the board?")
    empty = [p for p in poses if not any(s.pose == p for s in sightings)]
    if empty and sightings:
        out.append(f"no board in {', '.join(empty)}: take that again, or remove the folder")
    seen = {s.pose for s in sightings}
    if sightings and len(seen) < 8:
        shows = "1 pose shows" if len(seen) == 1 else f"{len(seen)} poses show"
        out.append(f"{shows} the board; take eight to ten, tilted by 20 to 30 degrees to all sides, near and far")
    if sightings and not any(len(s.square) or len(s.sample_px) for s in sightings):
        out.append("no projected phase was measured on the board: were fringes of both directions captured?")
    out.append("mend what the line above says, then run the same command again; the pictures of good poses can stay")
    return out
