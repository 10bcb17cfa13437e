"""Imagined futures: maps completed from what robots know, and copies of teams that play on them."""
