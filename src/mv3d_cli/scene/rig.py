"""Names of the rig's cameras; no numbers, so that a command's help can name them at once."""

HORIZONTAL = (
    "front", "back", "right", "left", "front_right", "front_left", "back_right", "back_left",
)  # fmt: skip
"""The rig's cameras at the height of the object, which are the ones generated."""
