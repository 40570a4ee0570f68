"""The only place that talks: commands, options, console."""
