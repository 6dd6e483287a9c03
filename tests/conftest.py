"""Fixtures and switches that all tests share."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, settings

ROOT = Path(__file__).resolve().parents[1]
SHARED = ROOT.parent / "shared"

# Numba compiles on the first call, so a time limit per example would judge the compiler.
settings.register_profile("fringescope", deadline=None, suppress_health_check=[HealthCheck.too_slow], print_blob=True)
settings.load_profile("fringescope")


@pytest.fixture(scope="session")
def root() -> Path:
    """The root of the repository."""
    return ROOT


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder of data sets beside the checkout; tests that need it are skipped where it is absent."""
    if not (SHARED / "data").is_dir():
        pytest.skip("no folder ../shared/data beside this checkout")
    return SHARED


@pytest.fixture
def rng() -> np.random.Generator:
    """Random numbers that are the same in every run."""
    return np.random.default_rng(20240229)


@pytest.fixture(scope="session")
def chromium() -> str:
    """A browser without a screen; skipped by name where there is none."""
    for name in ("chromium", "chromium-browser", "google-chrome"):
        if found := shutil.which(name):
            return found
    pytest.skip("no chromium here (tools/system_packages.sh installs it)")


@pytest.fixture(scope="session")
def gltf_validator() -> list[str]:
    """The command that judges a GLB by Khronos' validator: append the file, read JSON from stdout; skipped by name."""
    node = shutil.which("node")
    folder = ROOT / "tests" / "glb_validator"
    if node is None or not (folder / "node_modules" / "gltf-validator").is_dir():
        pytest.skip("Khronos' glTF validator is not installed (make setup; it needs Node.js)")
    return [node, str(folder / "validate.mjs")]


@pytest.fixture(scope="session")
def meshopt_reader() -> list[str]:
    """What unpacks a GLB by meshoptimizer's own decoder, as viewers do; append the file. Skipped by name."""
    node = shutil.which("node")
    folder = ROOT / "tests" / "glb_validator"
    if node is None or not (folder / "node_modules" / "meshoptimizer").is_dir():
        pytest.skip("meshoptimizer's decoder is not installed (make setup; it needs Node.js)")
    return [node, str(folder / "unpack.mjs")]
