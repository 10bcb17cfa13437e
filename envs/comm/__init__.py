"""Communication: strategies under limited radios, and what targets are worth to it."""
