"""Slow, obvious twins of kernels/adjust.py: OpenCV projects, rays meet the board by bisection, point by point."""

import cv2
import numpy as np
from scipy.optimize import brentq


def project(P, lens, R, t):
    """One point by OpenCV; `lens` = fx, fy, u0, v0, skew, k1, k2, p1, p2, k3 without skew."""
    K = np.array([[lens[0], 0, lens[2]], [0, lens[1], lens[3]], [0, 0, 1]])
    q, _ = cv2.projectPoints(np.asarray(P, float).reshape(1, 1, 3), cv2.Rodrigues(R)[0], t, K, np.asarray(lens[5:]))
    return q.ravel()


def surface(x, y, shape, frame):
    """Height of a bent board."""
    p, q = (x - frame[0]) / frame[2], (y - frame[1]) / frame[2]
    return shape[0] * p * p + shape[1] * p * q + shape[2] * q * q


def printed(x, y, shape, frame):
    """Where the print really put the point x, y of the board."""
    away = y - frame[1]
    X, Y = x + shape[4] * away, y + shape[3] * away
    return np.array([X, Y, surface(X, Y, shape, frame)])


def point_residual(xy, place, shape, frame, R_rb, t_rb, R_cr, t_cr, lens):
    """Predicted minus seen."""
    P = R_rb @ printed(*xy, shape, frame) + t_rb
    return project(P, lens, R_cr, t_cr) - place


def sample_residual(px, cycles, g, shape, frame, R_rb, t_rb, R_cr, t_cr, camera, projector):
    """Predicted minus measured, in plane units along each direction."""
    K = np.array([[camera[0], 0, camera[2]], [0, camera[1], camera[3]], [0, 0, 1]])
    stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 500, 1e-15)
    at = np.asarray(px, float).reshape(1, 1, 2)
    n = cv2.undistortPoints(at, K, np.asarray(camera[5:]), None, None, None, stop).ravel()
    ray = R_cr.T @ np.array([*n, 1.0])
    origin = -R_cr.T @ t_cr

    def above(s):
        q = R_rb.T @ (origin + s * ray - t_rb)
        return q[2] - surface(q[0], q[1], shape, frame)

    flat = R_rb[:, 2] @ (t_rb - origin) / (R_rb[:, 2] @ ray)
    s = brentq(above, 0.8 * flat, 1.2 * flat, xtol=1e-11)
    uv = project(origin + s * ray, projector, np.eye(3), np.zeros(3))
    return np.array([(np.dot(a, uv) - c) / np.linalg.norm(a) for a, c in zip(g, cycles, strict=True)])
