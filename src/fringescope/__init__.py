"""Fringescope: structured-light 3D imaging of tissue, and guidance projected back onto it.

The way of the data is the list of modules: capture -> phase -> denoise -> triangulate -> fuse -> guide. `pipeline`
holds the recipes, everything it is made of can be called alone, and `docs/conventions.md` fixes axes, units and signs.
"""

__version__ = "0.1.0"
