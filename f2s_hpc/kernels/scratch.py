"""Width of the scratch rows that the kernels of the Lagrangian step share."""

from __future__ import annotations

W = 64
"""Cells of a row are worked on in chunks of this many; all scratch rows of a chunk lie in one array at fixed
distances, so the compiler sees that they do not overlap and vectorises, and they stay in the first cache."""
