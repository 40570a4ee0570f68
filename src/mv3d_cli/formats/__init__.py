"""Bytes <-> scene values; the only code that opens such files. Axes and units as in `scene.conventions`."""
