"""A suite for tests: two parts of `minival`, four short episodes each."""

import re
from pathlib import Path

from maexp.agents.benchmarks.suites.frozen import freeze
from maexp.agents.benchmarks.suites.suite import FOLDER, load_suite

SMALLER = {"episodes: 16": "episodes: 4", "macro_steps: 15": "macro_steps: 4", "count: 8": "count: 2"}


def make_small_suite(path: Path) -> Path:
    """Writes and freezes it; returns the path."""
    text = (FOLDER / "minival.yaml").read_text()
    text = re.sub(r"  random_obstacles:\n.*?(?=  indoor_small:)", "", text, flags=re.DOTALL)
    text = re.sub(r"  outdoor:\n.*", "", text, flags=re.DOTALL).replace("name: minival", f"name: {path.stem}")
    for large, less in SMALLER.items():
        assert large in text
        text = text.replace(large, less)
    path.write_text(text)
    freeze(load_suite(str(path)), {})
    return path
