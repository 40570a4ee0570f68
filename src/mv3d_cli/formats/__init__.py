"""Bytes <-> scene values; the only code that opens such files."""
