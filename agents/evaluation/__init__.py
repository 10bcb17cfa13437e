"""Evaluation: episodes of any policy, results and their comparison, plots and films."""
