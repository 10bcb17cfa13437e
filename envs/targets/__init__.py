"""Frontier targets: search, features, heuristics, and the observation of a learned choice among them."""
