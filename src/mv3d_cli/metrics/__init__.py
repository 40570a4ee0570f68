"""Pure numbers: how alike two pictures, two depth maps, two shapes are."""
