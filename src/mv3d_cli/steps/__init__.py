"""One file per command: a frozen Config dataclass and `run(config, inputs) -> Artifact`. Here the legs meet."""
