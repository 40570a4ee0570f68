"""Values: frozen dataclasses of arrays. `conventions` states axes, units and colour space for the whole house."""
