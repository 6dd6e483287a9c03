"""Looks at the twin's scenes before and after something befell them: what the tests of watching share."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from fringescope import watch
from fringescope.twin import changes, presets, render, scene
from fringescope.twin.presets import Instrument
from fringescope.types import Bool, Grid, NoiseModel, Picture, PixelFormat

SPECIMENS = ("tissue-domed", "tissue-folded", "tissue-thin")


def noise_of(inst: Instrument, fmt: PixelFormat) -> NoiseModel:
    """The sensor's own: shot noise above the black level, read noise, rounding."""
    s, top = inst.sensor, fmt.max_value
    black = s.offset_share * top
    unit = (top - black) / s.full_well
    return NoiseModel((unit * s.read_noise) ** 2 - unit * black + 1 / 12, unit, "truth")


def grids_of(view: scene.Scene, inst: Instrument) -> list[Grid]:
    """What a perfect scan would give: the twin's points where the projector reaches them."""
    r = render.Renderer(view, inst, rays=1, mirrors=False)
    W, H = inst.rig.projector.plane_size
    out = []
    for i, c in enumerate(inst.rig.cameras):
        t = r.truth(c.name)
        with np.errstate(invalid="ignore"):
            ok = t.lit & (t.uv > 3).all(-1) & (t.uv[..., 0] < W - 4) & (t.uv[..., 1] < H - 4)
        xyz = np.where(ok[..., None], t.xyz, np.nan).astype(np.float32)
        sigma = np.where(ok, np.float32(0.005), np.float32(np.nan))
        out.append(Grid(i, c.name, xyz, sigma, np.where(ok, 0, 1).astype(np.uint16)))
    return out


class Look:
    """A specimen, scanned; then looked at as often as one likes, after whatever befell it.

    Pictures without noise are rendered once per change; noise is drawn anew for each look.
    """

    def __init__(self, name: str, preset: str = "paper", scale: float = 0.0625, seed: int = 1, rays: int = 1) -> None:
        self.scene, self.inst, self._rays = scene.make(name, seed), presets.instrument(preset, scale), rays
        self.grids = grids_of(self.scene, self.inst)
        self.rig = self.inst.rig
        self._still = self.light(self.scene)

    def light(self, view: scene.Scene) -> dict[str, np.ndarray]:
        """The signal of every camera under the ring light, without noise. Mirrored fringes need no ray: it is dark."""
        r = render.Renderer(view, self.inst, self._rays, mirrors=False)
        return {c.name: r.signal(c.name, None, 1.0) for c in self.rig.cameras}

    def frame(self, camera: str, signal: np.ndarray, seed: int, fmt: PixelFormat | None = None) -> np.ndarray:
        """Raw codes of a signal, with the noise of `seed`."""
        i = self.rig.index(camera)
        rng = np.random.default_rng([seed, 5, i])
        own = fmt or self.inst.pixel_formats[i]
        return self.inst.sensor.read(signal.ravel(), self.inst.electrons, own, 1.0, rng).reshape(signal.shape)

    def views(
        self,
        after: scene.Scene | Mapping[str, np.ndarray] | None = None,
        seed: int = 1,
        masks: Mapping[str, Bool] | None = None,
        brighter: float = 1.0,
    ) -> list[watch.View]:
        """What `watch.compare` takes. `after`: the scene now, or its signals (None: nothing befell it)."""
        now = self._still if after is None else self.light(after) if isinstance(after, scene.Scene) else after
        out = []
        for g in self.grids:
            fmt = self.inst.pixel_formats[g.view]
            then = Picture(g.camera, self.frame(g.camera, self._still[g.camera], 2 * seed), fmt)
            live = Picture(g.camera, self.frame(g.camera, brighter * now[g.camera], 2 * seed + 1), fmt)
            mask = None if masks is None else masks[g.camera]
            out.append(watch.View(g, then, live, mask, noise_of(self.inst, fmt)))
        return out


def befallen(view: scene.Scene, kind: str, seed: int) -> scene.Scene:
    """A specimen moved by 0.3 mm, turned by 0.5 degrees about its middle, or dented by 0.5 mm: which way and where is
    random.
    """
    rng = np.random.default_rng([seed, {"move": 1, "turn": 2, "dent": 3}[kind]])
    way = rng.normal(size=3)
    way /= np.linalg.norm(way)
    none = np.zeros(3)
    if kind == "move":
        return changes.moved(view, changes.motion(0.3 * way, none, none))
    if kind == "turn":
        return changes.moved(view, changes.motion(none, np.radians(0.5) * way, changes.middle(view)))
    a, r = rng.uniform(0, 2 * np.pi), np.sqrt(rng.uniform(0, 0.6**2))
    return changes.dented(view, (36 * r * np.cos(a), 22 * r * np.sin(a)), 0.5, rng.uniform(3, 6))
