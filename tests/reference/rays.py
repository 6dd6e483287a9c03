"""Slow, obvious twins of kernels/rays.py: OpenCV's projection and a root finder; the paper's closed form."""

import cv2
import numpy as np
from scipy.optimize import brentq


def projector_uv(projector, p_world):
    """OpenCV's projection of world points (n, 3) onto the projector plane (n, 2)."""
    rvec = cv2.Rodrigues(projector.pose.R)[0]
    p = np.ascontiguousarray(np.reshape(p_world, (-1, 3)), float)
    return cv2.projectPoints(p, rvec, projector.pose.t, projector.lens.K, projector.lens.distortion)[0].reshape(-1, 2)


def phase(projector, g, p_world):
    """Phase of gradient g at world points (n, 3)."""
    return 2 * np.pi * projector_uv(projector, p_world) @ np.asarray(g)


def camera_rays(camera):
    """Origin (3,) and unit directions (H, W, 3) in the world of all pixels, by iterating OpenCV's projection."""
    L = camera.lens
    v, u = np.mgrid[: L.height, : L.width].astype(float)
    want = np.stack([u.ravel(), v.ravel()], -1)
    inverse_K = np.linalg.inv(L.K[:2, :2])
    n = (want - L.K[:2, 2]) @ inverse_K.T
    zero = np.zeros(3)
    for _ in range(200):
        ahead = np.column_stack([n, np.ones(len(n))])
        miss = want - cv2.projectPoints(ahead, zero, zero, L.K, L.distortion)[0].reshape(-1, 2)
        n = n + miss @ inverse_K.T
        if np.abs(miss).max() < 1e-11:
            break
    assert np.abs(miss).max() < 1e-8
    d = np.column_stack([n, np.ones(len(n))])
    d = (d / np.linalg.norm(d, axis=1, keepdims=True)) @ camera.pose.R
    return -camera.pose.R.T @ camera.pose.t, d.reshape(L.height, L.width, 3)


def meet(projector, g, phi, origin, direction, near, far):
    """The point where a camera ray carries phase phi, between two distances along it, by bisection."""
    s = brentq(lambda s: float(phase(projector, g, origin + s * direction)[0]) - phi, near, far, xtol=1e-11, rtol=1e-14)
    return origin + s * direction


def paper_point(camera, projector, g, phi, u, v):
    """Equations 8 to 15 for one pixel, as printed but with l_p across the gradient: M = k T_p T_c^+, no distortion."""
    Kp, Kc = projector.lens.K, camera.lens.K
    g = np.asarray(g)
    P0 = Kp[:2, 2]  # principal point; the phase grows from there along the gradient
    on_fringe = P0 + g * (phi / (2 * np.pi) - g @ P0) / (g @ g)
    O_P = np.array([*((on_fringe - P0) / (Kp[0, 0], Kp[1, 1])), 1.0])
    l_p = np.array([-g[1] / Kp[0, 0], g[0] / Kp[1, 1], 0.0])
    k = np.cross(O_P, l_p)
    T_p = np.column_stack([projector.pose.R, projector.pose.t])
    T_c = np.eye(4)
    T_c[:3, :3], T_c[:3, 3] = camera.pose.R, camera.pose.t
    T_c_plus = np.linalg.pinv(T_c)
    M = k @ T_p @ T_c_plus
    x, y = (u - Kc[0, 2]) / Kc[0, 0], (v - Kc[1, 2]) / Kc[1, 1]
    Z = -M[3] / (M[0] * x + M[1] * y + M[2])
    return (T_c_plus @ (Z * x, Z * y, Z, 1.0))[:3]
