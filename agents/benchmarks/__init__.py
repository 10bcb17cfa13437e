"""`maexp benchmark`: policies on scenarios over seeds, cell by cell in worker processes, then tables and pictures."""
