"""Field to mesh: surface extraction, repair, simplification, unwrapping and texture baking."""
