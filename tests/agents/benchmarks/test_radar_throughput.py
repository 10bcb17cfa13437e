"""The radar's kernels beside a dense PyTorch version of the same filter: the same verdicts, and a ratio of times."""

import pytest
import torch
from dense_radar import Scene, measure_ratio

pytestmark = pytest.mark.slow  # measurements of speed

RECORDED_RATIO = 210
"""Dense over kernels, processor time of one thread. To record it anew: `python tests/helpers/dense_radar.py`."""
ATTEMPTS = 3


def test_the_dense_filter_gives_the_same_verdicts():
    scene = Scene(torch.float64)
    for e, dense in enumerate(scene.dense()):
        seen = torch.as_tensor(scene.env.snapshot(e)["visible"][0])
        assert torch.equal(dense, seen), f"env {e}: {int((dense != seen).sum())} points differ"
        assert 0 < int(seen.sum()) < len(seen)


def test_the_ratio_to_the_dense_filter_holds():
    """Both run in turns and count processor time, so noise hardly matters; a change of more than 2 x fails."""
    ratios = []
    for _ in range(ATTEMPTS):
        ratios.append(measure_ratio())
        if RECORDED_RATIO / 2 < ratios[-1] < RECORDED_RATIO * 2:
            return
    found = ", ".join(f"{ratio:.0f}" for ratio in ratios)
    raise AssertionError(
        f"the dense filter takes {found} times as long as the kernels, recorded is {RECORDED_RATIO}: the radar became "
        "slower, or so much faster that the record is out of date (see RECORDED_RATIO)"
    )
