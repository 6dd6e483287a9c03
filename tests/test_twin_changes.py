"""What befalls a scene: it moves rigidly with its texture, it is pressed in where it is said, and errors say why."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from fringescope import capture
from fringescope.devices import registry, simulated
from fringescope.errors import UsageError
from fringescope.twin import changes, scene
from fringescope.twin.shapes import Mesh, Plane, trace

AT = changes.motion(np.array([0.4, -0.2, 0.3]), np.radians([2.0, -1.0, 30.0]), np.array([3.0, 1.0, 2.0]))


def down(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rays from high above straight down through (x, y)."""
    o = np.column_stack([points, np.full(len(points), 200.0)])
    return o, np.broadcast_to([0.0, 0.0, -1.0], o.shape)


def test_motion_is_opencvs_rotation_about_the_point() -> None:
    turn = np.radians([2.0, -1.0, 30.0])
    R, _ = cv2.Rodrigues(turn)
    np.testing.assert_allclose(AT.R, R, atol=1e-12)
    np.testing.assert_allclose(AT.R @ [3.0, 1.0, 2.0] + AT.t, [3.4, 0.8, 2.3], atol=1e-12)


@pytest.mark.parametrize("name", ["tissue-folded", "sphere", "steps", "board"])
def test_what_moves_takes_its_texture_and_its_film_along(name: str) -> None:
    """The same ray of light, moved too, meets the same place of the same colour."""
    still = scene.make(name, 3)
    there = changes.moved(still, AT)
    assert there.shapes[0] is still.shapes[0]
    o, d = down(np.random.default_rng(1).uniform(-15, 15, (400, 2)))
    before, after = still.shapes[1:], there.shapes[1:]
    a, b = trace(before, o, d), trace(after, o @ AT.R.T + AT.t, d @ AT.R.T)
    hit = (a.shape >= 0) & (b.shape >= 0)
    assert hit.sum() > (20 if name == "sphere" else 300)
    np.testing.assert_allclose((a.point @ AT.R.T + AT.t)[hit], b.point[hit], atol=1e-4)
    np.testing.assert_allclose((a.normal @ AT.R.T)[hit], b.normal[hit], atol=1e-4)
    for k, (s, m) in enumerate(zip(before, after, strict=True)):
        one = hit & (a.shape == k) & (b.shape == k)
        p, q = s.local(a.point[one]), m.local(b.point[one])
        np.testing.assert_allclose(s.finish.albedo(p), m.finish.albedo(q), atol=5e-3)
        if s.finish.bumps is not None and m.finish.bumps is not None:
            np.testing.assert_allclose(s.finish.bumps(p) @ AT.R[:2, :2].T, m.finish.bumps(q), atol=5e-3)


def test_everything_moves_where_it_is_asked_and_the_truth_follows() -> None:
    still = scene.make("tissue-thin", 3)
    there = changes.moved(still, AT, everything=True)
    floor, before = there.shapes[0], still.shapes[0]
    assert isinstance(floor, Plane)
    assert isinstance(before, Plane)
    np.testing.assert_allclose(floor.pose.t, AT.R @ before.pose.t + AT.t)
    mesh = there.shapes[1]
    assert isinstance(mesh, Mesh)
    np.testing.assert_allclose(there.truth["tissue_mesh.npz"]["V"], mesh.vertices, atol=1e-12)
    twice = changes.moved(there, AT, everything=True)
    P = np.random.default_rng(2).normal(size=(5, 3))
    np.testing.assert_allclose(twice.shapes[1].local((P @ AT.R.T + AT.t) @ AT.R.T + AT.t), P, atol=1e-9)


@pytest.mark.parametrize("first", [None, AT])
def test_a_dent_is_as_deep_as_it_says_and_keeps_normals_and_texture_true(first: object) -> None:
    still = scene.make("tissue-domed", 2)
    if first is not None:
        still = changes.moved(still, AT)
    pressed = changes.dented(still, (4.0, -2.0), 0.5, 6.0)
    a, b = still.shapes[1], pressed.shapes[1]
    assert isinstance(a, Mesh)
    assert isinstance(b, Mesh)
    gone = np.linalg.norm(a.vertices - b.vertices, axis=1)
    away = np.linalg.norm((a.local(a.vertices) - a.local(np.array([[4.0, -2.0, a.pose.t[2]]])))[:, :2], axis=1)
    np.testing.assert_allclose(gone, 0.5 * np.clip(1 - (away / 6) ** 2, 0, None) ** 3, atol=1e-12)
    assert gone.max() == pytest.approx(0.5, abs=0.01)
    np.testing.assert_allclose(a.local(a.vertices)[:, :2], b.local(b.vertices)[:, :2], atol=1e-9)  # the map of colours
    near = np.flatnonzero((away[b.faces] < 5.5).all(1))
    p, q, r = (b.vertices[b.faces[near, k]] for k in range(3))
    flat = np.cross(q - p, r - p)
    flat /= np.linalg.norm(flat, axis=1, keepdims=True)
    cos = np.abs((flat * b.normals[b.faces[near]].mean(1)).sum(1))
    assert np.degrees(np.arccos(np.clip(cos, 0, 1))).mean() < 1.5


def test_the_world_changes_while_its_devices_are_open() -> None:
    with registry.open_station("sim://pair/tissue-thin?scale=0.03&seed=4&noise=0") as s:
        assert isinstance(s, simulated.SimulatedStation)
        assert s.light is not None

        def look() -> np.ndarray:
            return capture.photograph(s.projector, s.cameras, s.light)[0].astype(float)

        first = look()
        np.testing.assert_array_equal(first, look())
        s.world.change(changes.relit(s.world.scene, 0.5))
        dim = look()
        assert np.median((dim - 2) / (first - 2)) == pytest.approx(0.52, abs=0.05)  # the room's light stays
        s.world.change(changes.covered(s.world.scene, 60))
        assert np.abs(look() - dim).max() > 20


@pytest.mark.parametrize(
    ("query", "why"),
    [
        ("move=1", "needed 3 numbers"),
        ("move=1,2,x", "needed 3 numbers"),
        ("turn=1,2", "needed 1 or 3 numbers"),
        ("turn=nan", "needed 1 or 3"),
        ("dent=1,2", "needed 1 or 3 or 4"),
        ("dent=0.5,55,0", "no tissue within"),
        ("dent=0.5,0,0,-1", "a radius"),
        ("dry=2", "share of 0 to 1"),
        ("ring=-1", "0 or more"),
        ("layout=round", "grid or diamond"),
        ("noise=-1", "count from 0"),
    ],
)
def test_changes_that_cannot_be(query: str, why: str) -> None:
    with pytest.raises(UsageError, match=why):
        simulated.parse(f"sim://pair/tissue-thin?scale=0.03&{query}")


def test_a_scene_without_tissue_has_no_dent() -> None:
    with pytest.raises(UsageError, match="needed tissue"):
        changes.dented(scene.make("plane", 1), (0, 0), 0.5)


def test_the_uri_tells_changes() -> None:
    world = simulated.parse("sim://pair/tissue-thin?scale=0.03&seed=2&move=0.3,0,0&turn=0.5&dent=0.5,1,2&dry=0.2&ring=0.9")
    still = scene.make("tissue-thin", 2)
    assert world.scene.ring == pytest.approx(0.9 * still.ring)
    assert world.scene.shapes[1].finish.f0 == pytest.approx(0.8 * still.shapes[1].finish.f0)
    mesh, before = world.scene.shapes[1], still.shapes[1]
    assert isinstance(mesh, Mesh)
    assert isinstance(before, Mesh)
    R, _ = cv2.Rodrigues(np.array([0, 0, np.radians(0.5)]))
    m = changes.middle(still)
    undented = (before.vertices - m) @ R.T + m + [0.3, 0, 0]
    off = np.linalg.norm(mesh.vertices - undented, axis=1)
    assert off.max() == pytest.approx(0.5, abs=0.01)
    assert (off < 1e-9).mean() > 0.9
