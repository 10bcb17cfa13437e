"""Suites: frozen worlds with names, one score, and results that others can play again."""
