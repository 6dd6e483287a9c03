"""Truth files of a simulated capture, laid out as a judge reads them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from fringescope.errors import OutputError
from fringescope.twin.scene import Scene
from fringescope.types import Camera, Layout, Projector, Rig


def rig_dict(rig: Rig) -> dict[str, Any]:
    """A rig as the contract's JSON values."""

    def device(d: Camera | Projector) -> dict[str, Any]:
        return {
            "K": d.lens.K.tolist(),
            "distortion": d.lens.distortion.tolist(),
            "R": d.pose.R.tolist(),
            "t": d.pose.t.tolist(),
        }

    p = rig.projector
    out: dict[str, Any] = {"format": "fringescope-rig", "version": 1, "units": "mm"}
    out["projector"] = {"width": p.width, "height": p.height, "layout": Layout(p.layout).value, **device(p)}
    out["cameras"] = [
        {"name": c.name, "width": c.lens.width, "height": c.lens.height, **device(c)} for c in rig.cameras
    ]
    if rig.volume is not None:
        v = rig.volume
        out["volume"] = {"center": v.center.tolist(), "axes": v.axes.tolist(), "half_size": v.half_size.tolist()}
    return out


def write(scene: Scene, rig: Rig, folder: Path) -> None:
    """Writes `rig.json` and the scene's truth files to `folder`, which is made if it is missing.

    Raises OutputError if that cannot be done.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "rig.json").write_text(json.dumps(rig_dict(rig), indent=1) + "\n", encoding="utf-8")
        for name, content in scene.truth.items():
            if name.endswith(".npz"):
                np.savez_compressed(folder / name, **content)
            else:
                (folder / name).write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    except OSError as e:
        raise OutputError(
            f"{folder}: the truth cannot be written ({e.strerror}); choose another folder or free space"
        ) from e
