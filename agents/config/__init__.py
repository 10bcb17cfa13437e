"""From the words of a command line to checked settings: overrides, Hydra composition, the typed schema, ranges."""
