"""Scripts for developers, run from the root of the source: `python -m tests.tools.gallery docs/gallery`."""
