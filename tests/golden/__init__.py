"""Recorded episodes that guard behaviour: `python -m tests.golden.record` records them anew (CONTRIBUTING.md)."""
