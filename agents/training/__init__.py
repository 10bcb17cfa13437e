"""Training: the loop, the collectors and workers that feed it, checkpoints, logs and the warm start."""
