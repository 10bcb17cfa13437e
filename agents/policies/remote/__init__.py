"""Policies outside this process: NumPy and user policies, their subprocess workers, protocol and server."""
